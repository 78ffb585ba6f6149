// The map of a flight, north up: what lies under and over the path. The path and the aircraft are those of the scene.
import {windText} from "./units.js";

const EDGE = 46; // px, that the mission keeps from the edge of the canvas
export const AIRCRAFT = 30; // px, drawn span
const FIRST_EXTENT = 200; // m, least extent of the map that shows everything
const SAMPLED = 300; // places of the path that the extent is taken from
const SCALE_BAR = 120; // px, longest
const BESIDE = 12; // px, of the number of a leg beside its place
const ARROW = 26; // px, of the wind
const MARGIN = 16; // px, of the marks in the corners
const WIND = 230; // px, width of the wind with its text
const TEXT = 14; // px, height of a label with its space
const FAR = 3; // times BESIDE, the farthest that a label lies from its place, and
const FARTHEST = 10; // that of one that has to be drawn

// The part of the world that shows the route, the fence and home of the first flight, and the paths of all: centre in m, px a metre.
export function extentOf(flights, width, height) {
  const {route = [], fence = [], home = null} = flights[0].info, places = route.map(([north, east]) => [north, east]);
  if (home) places.push(home);
  for (const zone of fence) {
    zone.north.forEach((north, k) => {
      const reach = zone.radius ?? 0;
      places.push([north - reach, zone.east[k] - reach], [north + reach, zone.east[k] + reach]);
    });
  }
  for (const pose of flights.map(flight => flight.get("pose"))) {
    const [north, east] = ["north", "east"].map(name => pose?.column(name)), step = Math.ceil(pose ? pose.count / SAMPLED : 1);
    for (let k = 0; north && east && k < pose.count + step - 1; k += step) {
      const row = Math.min(k, pose.count - 1);
      if (Number.isFinite(north[row] + east[row])) places.push([north[row], east[row]]);
    }
  }
  if (!places.length) places.push([0, 0]);
  const [low, high] = [Math.min, Math.max].map(of => [0, 1].map(axis => places.reduce((value, place) => of(value, place[axis]), places[0][axis])));
  const fits = [height, width].map((pixels, axis) => Math.max(pixels - 2 * EDGE, 50) / Math.max(high[axis] - low[axis], FIRST_EXTENT));
  return {centre: [0, 1].map(axis => (low[axis] + high[axis]) / 2), scale: Math.min(...fits)};
}

// Screen coordinates of a point, and a depth by which the lower one is drawn first.
export function mapped({centre, scale}, width, height) {
  return ([north, east, down = 0]) => [width / 2 + (east - centre[1]) * scale, height / 2 - (north - centre[0]) * scale, 1e7 + down];
}

// The span of the aircraft on the map, m.
export const mapSpan = ({scale}) => AIRCRAFT / scale;

function outline(ctx, see, points, closed) {
  ctx.beginPath();
  points.forEach((point, k) => {
    const [x, y] = see(point);
    if (k) ctx.lineTo(x, y); else ctx.moveTo(x, y);
  });
  if (closed) ctx.closePath();
  ctx.stroke();
}

// What lies under the path: the background of the user, the fence and home.
export function drawGround(ctx, see, {scale}, {background = [], fence = [], home = null}, colour) {
  ctx.strokeStyle = ctx.fillStyle = colour("--ground");
  ctx.lineWidth = 1;
  for (const points of background) {
    if (points.length > 1) outline(ctx, see, points, false);
    else ctx.fillRect(see(points[0])[0] - 2, see(points[0])[1] - 2, 4, 4);
  }
  ctx.strokeStyle = ctx.fillStyle = colour("--bad");
  ctx.lineWidth = 2;
  for (const zone of fence) {
    ctx.setLineDash(zone.exclude ? [3, 3] : []);
    const points = zone.north.map((north, k) => [north, zone.east[k]]);
    if (zone.radius) {
      const [x, y] = see(points[0]);
      ctx.beginPath();
      ctx.arc(x, y, zone.radius * scale, 0, 2 * Math.PI);
      ctx.stroke();
    } else outline(ctx, see, points, true);
    if (!zone.exclude) continue;
    ctx.globalAlpha = 0.15;
    ctx.fill();
    ctx.globalAlpha = 1;
  }
  ctx.setLineDash([]);
  if (home) mark(ctx, see(home), "H", colour("--good"), colour);
}

function mark(ctx, [x, y], text, fill, colour) { // a letter on a disc
  ctx.fillStyle = fill;
  ctx.beginPath();
  ctx.arc(x, y, 8, 0, 2 * Math.PI);
  ctx.fill();
  label(ctx, text, x, y, colour("--paper"), "center");
}

// The texts of a picture: each is drawn beside its place, where it covers no other text.
export class Labels {
  constructor(ctx) {
    this.ctx = ctx;
    this.taken = [];
  }

  take(x, y, width, height) {
    this.taken.push([x, y, x + width, y + height]);
  }

  isFree([left, top, right, bottom]) {
    return this.taken.every(([x, y, to, low]) => right <= x || left >= to || bottom <= y || top >= low);
  }

  // The centre of a free rectangle beside a place, from near to far; null without one.
  centre([x, y], width, farthest) {
    for (let distance = BESIDE; distance <= farthest * BESIDE; distance += BESIDE / 2) {
      for (const [right, down] of [[1, -1], [1, 1], [-1, 1], [-1, -1], [0, -1], [0, 1], [1, 0], [-1, 0]]) {
        const [at, level] = [x + right * (distance / 2 + width / 2), y + down * distance];
        if (this.isFree([at - width / 2, level - TEXT / 2, at + width / 2, level + TEXT / 2])) return [at, level];
      }
    }
    return null;
  }

  // A text beside a place; one that is `needed` is drawn on another text rather than left out.
  add(text, place, fill, {needed = false, disc = null} = {}) {
    this.ctx.font = "600 11px system-ui, sans-serif";
    const width = Math.max(this.ctx.measureText(text).width + 4, disc ? 17 : 0);
    const at = this.centre(place, width, needed ? FARTHEST : FAR) ?? (needed ? [place[0] + BESIDE, place[1] - BESIDE] : null);
    if (!at) return;
    this.take(at[0] - width / 2, at[1] - TEXT / 2, width, TEXT);
    if (disc) mark(this.ctx, at, text, fill, disc);
    else label(this.ctx, text, ...at, fill, "center");
  }
}

export function label(ctx, text, x, y, fill, align) {
  ctx.fillStyle = fill;
  ctx.font = "600 11px system-ui, sans-serif";
  ctx.textAlign = align;
  ctx.textBaseline = "middle";
  ctx.fillText(text, x, y);
  ctx.textBaseline = "alphabetic";
}

// Waypoints with their altitudes, and the numbers of the legs, those of `target leg=`; the leg that is flown is filled.
export function drawMission(ctx, see, labels, {waypoints = [], legs = []}, leg, units, colour) {
  ctx.lineWidth = 1.5;
  ctx.strokeStyle = colour("--ink");
  for (const [north, east, altitude] of waypoints) {
    const [x, y] = see([north, east]);
    ctx.fillStyle = colour("--paper");
    ctx.beginPath();
    ctx.arc(x, y, 4, 0, 2 * Math.PI);
    ctx.fill();
    ctx.stroke();
    labels.take(x - 5, y - 5, 10, 10);
  }
  for (const [number, north, east] of legs) {
    labels.add(`${number}`, see([north, east]), colour("--ink"), {needed: number === leg, disc: number === leg ? colour : null});
  }
  const height = ([north, east, altitude]) => [`${(altitude * units.height.factor).toFixed(0)} ${units.height.unit}`, [north, east]];
  for (const [text, place] of new Map(waypoints.map(height).map(label => [`${label}`, label])).values()) { // of waypoints at one place once
    labels.add(text, see(place), colour("--quiet"));
  }
}

// The circle that is commanded: centre and radius in m.
export function drawOrbit(ctx, see, {scale}, north, east, radius, colour) {
  const [x, y] = see([north, east]);
  ctx.strokeStyle = colour("--reference");
  ctx.lineWidth = 2;
  ctx.setLineDash([6, 4]);
  ctx.beginPath();
  ctx.arc(x, y, Math.abs(radius) * scale, 0, 2 * Math.PI);
  ctx.moveTo(x - 5, y);
  ctx.lineTo(x + 5, y);
  ctx.moveTo(x, y - 5);
  ctx.lineTo(x, y + 5);
  ctx.stroke();
  ctx.setLineDash([]);
}

// Keep labels off the marks in the corners.
export function takeMarks(labels, width, height) {
  labels.take(0, 0, MARGIN + WIND, MARGIN + 40);
  labels.take(width - MARGIN - SCALE_BAR, height - MARGIN - 22, MARGIN + SCALE_BAR, MARGIN + 22);
}

// North, the scale and the wind, in the corners.
export function drawMarks(ctx, width, height, {scale}, wind, units, colour) {
  ctx.strokeStyle = ctx.fillStyle = colour("--ink");
  ctx.lineWidth = 2;
  arrow(ctx, MARGIN, MARGIN + 34, 0, -ARROW, colour("--ink"));
  label(ctx, "N", MARGIN, MARGIN - 6, colour("--ink"), "center");
  const {unit, factor} = SCALE_BAR / scale < 1000 ? units.near : units.far;
  const longest = SCALE_BAR / scale * factor, power = 10 ** Math.floor(Math.log10(longest));
  const shown = [5, 2, 1].map(digit => digit * power).find(value => value <= longest), long = shown / factor * scale;
  ctx.strokeStyle = colour("--ink");
  ctx.beginPath();
  ctx.moveTo(width - MARGIN - long, height - MARGIN - 5);
  ctx.lineTo(width - MARGIN - long, height - MARGIN);
  ctx.lineTo(width - MARGIN, height - MARGIN);
  ctx.lineTo(width - MARGIN, height - MARGIN - 5);
  ctx.stroke();
  label(ctx, `${Number(shown.toPrecision(1))} ${unit}`, width - MARGIN, height - MARGIN - 13, colour("--ink"), "right");
  if (!wind || Math.hypot(...wind) < 0.05) return;
  const [north, east] = wind.map(value => value / Math.hypot(...wind) * ARROW);
  arrow(ctx, MARGIN + 46 - east / 2, MARGIN + 20 + north / 2, east, -north, colour("--plant"));
  label(ctx, windText(units, ...wind), MARGIN + 24, MARGIN - 6, colour("--plant"), "left");
}

function arrow(ctx, x, y, right, down, fill) { // from a point on, with a head
  const angle = Math.atan2(down, right), tip = [x + right, y + down];
  ctx.strokeStyle = fill;
  ctx.lineWidth = 2;
  ctx.beginPath();
  ctx.moveTo(x, y);
  ctx.lineTo(...tip);
  for (const side of [-2.6, 2.6]) {
    ctx.moveTo(...tip);
    ctx.lineTo(tip[0] + 8 * Math.cos(angle + side), tip[1] + 8 * Math.sin(angle + side));
  }
  ctx.stroke();
}

// The aircraft in three dimensions on a 2-D canvas, and the artificial horizon. No WebGL.
// World: north, east, down (m). Body: forward, right, down. Angles in rad; matrices are rows.
import {MODE_COLOURS, prepared} from "./canvas.js";
import {AIRCRAFT, drawGround, drawMarks, drawMission, drawOrbit, extentOf, Labels, mapped, mapSpan, takeMarks} from "./map.js";
import {indexAt} from "./series.js";
import {UNITS} from "./units.js";

const SPAN = 3; // m, least drawn span
const RELATIVE_SPAN = 0.13; // of the distance of the camera: the aircraft stays visible from afar
const NEAR = 0.2; // m, nothing closer to the camera is drawn
const FULL_DEFLECTION = 25 * Math.PI / 180; // rad, of an input that is given as a fraction
const REVERSED = ["nose down", "roll left", "nose left"]; // motions by a positive input that are opposite to those of `aircraft`
const MAX_TRAIL = 1500; // points
const MAX_GAP = 0.5; // s between two poses, above which nothing is interpolated
const WRAPPED = new Set(["phi", "psi"]); // in (-pi, pi]
export const ON_ROUTE = 4; // flight_guidance.modes.modes.Lateral.ROUTE
const IN_ORBIT = 3; // flight_guidance.modes.modes.Lateral.ORBIT
const CLICK = 4; // px, that a pointer moves at most between down and up
const MARK = 12; // px, of a text in the corner
const MAX_WIND = 10; // m/s, drawn as one span

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const unit = a => plus([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));

// Body to world: R_z(psi) R_y(theta) R_x(phi).
export function rotation(phi, theta, psi) {
  const [cf, sf, ct, st, cp, sp] = [Math.cos(phi), Math.sin(phi), Math.cos(theta), Math.sin(theta), Math.cos(psi), Math.sin(psi)];
  return [
    [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
    [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
    [-st, sf * ct, cf * ct],
  ];
}

export const toWorld = (matrix, point) => matrix.map(row => dot(row, point));

// Polygons of the aircraft in body axes, span 1. Deflections in rad: elevator nose up, aileron roll right, rudder nose right.
export function aircraft({elevator = 0, aileron = 0, rudder = 0}) {
  const ring = [[0.04, 0, -0.045], [0.04, 0.04, 0], [0.04, 0, 0.045], [0.04, -0.04, 0]], polygons = [];
  const add = (part, ...points) => polygons.push({part, points});
  ring.forEach((point, k) => {
    add("body", [0.3, 0, 0.01], point, ring[(k + 1) % 4]);
    add("body", [-0.5, 0, -0.01], point, ring[(k + 1) % 4]);
  });
  for (const side of [1, -1]) {
    add("wing", [0.09, 0, 0], [0.05, 0.5 * side, -0.02], [-0.06, 0.5 * side, -0.02], [-0.06, 0, 0]);
    add("wing", [-0.06, 0, 0], [-0.06, 0.27 * side, -0.01], [-0.12, 0.27 * side, -0.01], [-0.13, 0, 0]);
    const x = -0.06 - 0.06 * Math.cos(aileron), z = -0.06 * Math.sin(aileron) * side; // right one up rolls right
    add("surface", [-0.06, 0.27 * side, -0.01], [-0.06, 0.5 * side, -0.02], [x, 0.5 * side, -0.02 + z], [x, 0.27 * side, -0.01 + z]);
    const tail = [-0.47 - 0.06 * Math.cos(elevator), -0.01 - 0.06 * Math.sin(elevator)]; // trailing edge up
    add("wing", [-0.4, 0, -0.01], [-0.43, 0.18 * side, -0.01], [-0.47, 0.18 * side, -0.01], [-0.47, 0, -0.01]);
    add("surface", [-0.47, 0, -0.01], [-0.47, 0.18 * side, -0.01], [tail[0], 0.18 * side, tail[1]], [tail[0], 0, tail[1]]);
  }
  const fin = [-0.47 - 0.06 * Math.cos(rudder), 0.06 * Math.sin(rudder)]; // trailing edge right
  add("wing", [-0.38, 0, -0.01], [-0.44, 0, -0.17], [-0.47, 0, -0.17], [-0.47, 0, -0.01]);
  add("surface", [-0.47, 0, -0.01], [-0.47, 0, -0.17], [fin[0], fin[1], -0.17], [fin[0], fin[1], -0.01]);
  return polygons;
}

// A camera at a point, looking along a direction; `right` is given where that is vertical.
export function camera(position, forward, right) {
  const ahead = unit(forward), side = right ?? unit(cross([0, 0, 1], ahead));
  return {position, ahead, side, down: cross(ahead, side)};
}

// Screen coordinates and depth of a point; null behind the camera. `focal` in pixels.
export function project(eye, point, focal, width, height) {
  const from = plus(point, eye.position, -1), depth = dot(from, eye.ahead);
  if (depth < NEAR) return null;
  return [width / 2 + focal * dot(from, eye.side) / depth, height / 2 + focal * dot(from, eye.down) / depth, depth];
}

// The pose of a flight at a time, interpolated, world coordinates; null where the log has none. Without a place it stays at the
// origin.
// A log without the topic has the attitude of `truth`, for an airframe the deviation from trim.
export function poseAt(flight, t) {
  const pose = flight.get("pose"), row = pose ? indexAt(pose.t, pose.count, t) : -1;
  if (!pose) {
    const [phi, theta] = ["x.phi", "x.theta"].map(name => flight.get("truth")?.at(name, t) ?? NaN), attitude = Number.isFinite(phi + theta);
    return attitude ? {row, phi, theta, psi: 0, attitude, place: [0, 0, 0]} : null;
  }
  if (row < 0) return null;
  const next = Math.min(row + 1, pose.count - 1), gap = pose.t[next] - pose.t[row];
  const part = gap > 0 && gap < (pose.gap ?? MAX_GAP) ? Math.min((t - pose.t[row]) / gap, 1) : 0;
  const value = name => {
    const column = pose.column(name);
    if (!column) return NaN;
    const step = column[next] - column[row];
    return column[row] + part * (WRAPPED.has(name) ? step - 2 * Math.PI * Math.round(step / (2 * Math.PI)) : step);
  };
  const finite = name => (Number.isFinite(value(name)) ? value(name) : 0);
  const [phi, theta, psi] = [value("phi"), value("theta"), finite("psi")];
  return {
    row, phi, theta, psi, attitude: Number.isFinite(phi) && Number.isFinite(theta),
    place: [finite("north"), finite("east"), -finite("altitude")],
    speed: Math.hypot(value("v_north"), value("v_east")), climb: value("climb"), altitude: value("altitude"),
  };
}

// Deflections for `aircraft`: of the actuators where they are simulated, else of u, each in the sense that its airframe gives it.
export function deflections(flight, t) {
  const found = {}, internals = flight.get("internals");
  for (const name of ["elevator", "aileron", "rudder"]) {
    let value = flight.get("truth")?.at(`actuator.${name}`, t) ?? NaN;
    if (!Number.isFinite(value)) value = internals?.at(`u.${name}`, t) ?? flight.get("u")?.at(name, t) ?? NaN;
    const scale = ["deg", "rad", "crad"].includes(flight.info.units[name]?.unit) ? 1 : FULL_DEFLECTION;
    const sense = REVERSED.some(motion => flight.info.positive[name]?.startsWith(motion)) ? -1 : 1;
    if (Number.isFinite(value)) found[name] = Math.max(-1.2, Math.min(1.2, value * scale * sense));
  }
  return found;
}

export class Scene {
  // `clicked` takes a place on the map, north and east in m.
  constructor(canvas, changed, clicked = () => {}) {
    this.canvas = canvas;
    this.mode = "chase";
    this.distance = 16; // m, of the camera
    this.azimuth = 0.6; // rad, orbit
    this.elevation = 0.35;
    this.map = null; // of the map: centre, m, and px a metre; null shows everything
    this.shownMap = null; // as drawn last
    this.units = UNITS["m, m/s"];
    let held = null, pressed = null;
    canvas.addEventListener("pointerdown", event => {
      held = pressed = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", event => {
      if (!held) return;
      if (pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) <= CLICK) return;
      pressed = null;
      if (this.mode === "map" && this.shownMap) {
        const {centre, scale} = this.shownMap;
        this.map = {centre: [centre[0] + (event.clientY - held[1]) / scale, centre[1] - (event.clientX - held[0]) / scale], scale};
        this.shownMap = this.map; // further moves may come before the next picture
        held = [event.clientX, event.clientY];
        changed();
        return;
      }
      if (this.mode === "chase") this.mode = "orbit";
      this.azimuth -= (event.clientX - held[0]) * 0.008;
      this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + (event.clientY - held[1]) * 0.008));
      held = [event.clientX, event.clientY];
      changed();
    });
    canvas.addEventListener("pointerup", event => {
      if (pressed && this.mode === "map" && this.shownMap) clicked(this.placeAt(event));
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { held = pressed = null; });
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.0015));
      changed();
    }, {passive: false});
  }

  placeAt({clientX, clientY}) { // north and east of a point of the map, m
    const {left, top, width, height} = this.canvas.getBoundingClientRect(), {centre, scale} = this.shownMap;
    return [centre[0] - (clientY - top - height / 2) / scale, centre[1] + (clientX - left - width / 2) / scale];
  }

  show(mode) { // the map shows everything
    this.mode = mode;
    this.distance = 16;
    this.map = null;
  }

  zoom(factor) {
    if (this.mode === "map" && this.shownMap) {
      this.map = this.shownMap = {...this.shownMap, scale: Math.max(1e-4, Math.min(20, this.shownMap.scale / factor))};
      return;
    }
    this.distance = Math.max(3, Math.min(1e5, this.distance * factor));
  }

  eye({place, psi}) {
    const azimuth = this.mode === "chase" ? psi : this.azimuth, elevation = this.mode === "chase" ? 0.28 : this.elevation;
    const ahead = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    return camera(plus(place, ahead, -this.distance), ahead);
  }

  // `others` are further flights, each with its name, "" for a ghost, and its flight time.
  draw(flight, others, t, colour) {
    const {ctx, width, height} = prepared(this.canvas), focal = 0.9 * Math.min(width, 1.6 * height);
    ctx.fillStyle = colour("--backdrop");
    ctx.fillRect(0, 0, width, height);
    const pose = poseAt(flight, t);
    if (!pose) {
      this.say(ctx, width, height, flight.get("pose")?.count || flight.series?.size === 0 ? "NO POSE YET" : "NO POSE IN THE LOG", colour);
      return;
    }
    const map = this.mode === "map", eye = map ? null : this.eye(pose);
    if (map) this.shownMap = this.map ?? extentOf([flight, ...others.map(beside => beside.flight)], width, height);
    const see = map ? mapped(this.shownMap, width, height) : point => project(eye, point, focal, width, height);
    if (map) {
      this.legend = "";
      drawGround(ctx, see, this.shownMap, flight.info, colour);
    } else {
      this.earth(ctx, eye, focal, width, height, colour);
      this.grid(ctx, see, pose, flight, colour);
    }
    this.route(ctx, see, flight, pose, colour);
    for (const beside of others) this.trail(ctx, see, beside.flight, Infinity, () => colour("--ghost"), 0.6);
    this.trail(ctx, see, flight, t, mode => MODE_COLOURS[mode] ?? colour("--plant"), 1);
    const labels = new Labels(ctx);
    if (map) takeMarks(labels, width, height);
    for (const beside of others) {
      const placed = poseAt(beside.flight, beside.t), at = placed && see(placed.place);
      if (!at) {
        if (map && beside.name) this.legend += `${beside.name}: no pose yet `;
        continue;
      }
      this.aircraft(ctx, see, placed, deflections(beside.flight, beside.t), colour, beside.name ? 0.7 : 0.35);
      labels.add(beside.name, at.slice(0, 2), colour("--ghost"), {needed: true});
    }
    const here = map && see(pose.place);
    if (here) labels.take(here[0] - AIRCRAFT / 2, here[1] - AIRCRAFT / 2, AIRCRAFT, AIRCRAFT); // a number beside the aircraft, not under it
    const guidance = flight.get("guidance"), winds = ["wind.north", "wind.east"].map(name => guidance?.at(name, t) ?? NaN);
    const lateral = guidance?.at("mode.lateral", t);
    if (map) drawMission(ctx, see, labels, flight.info, lateral === ON_ROUTE ? guidance.at("leg", t) : -1, this.units, colour);
    const orbit = ["north", "east", "radius"].map(name => guidance?.at(`target.${name}`, t) ?? NaN);
    if (map && lateral === IN_ORBIT && orbit.every(Number.isFinite)) drawOrbit(ctx, see, this.shownMap, ...orbit, colour);
    this.aircraft(ctx, see, pose, deflections(flight, t), colour, 1);
    if (map) drawMarks(ctx, width, height, this.shownMap, winds.every(Number.isFinite) ? winds : null, this.units, colour);
    else this.wind(ctx, see, flight, pose, t, colour);
    if (!pose.attitude) this.say(ctx, width, height, "NO ATTITUDE IN THE LOG", colour);
  }

  say(ctx, width, height, text, colour) {
    ctx.fillStyle = colour("--warn");
    ctx.font = "600 15px system-ui, sans-serif";
    ctx.textAlign = "center";
    ctx.fillText(text, width / 2, height / 2);
  }

  get span() {
    if (this.mode === "map" && this.shownMap) return mapSpan(this.shownMap);
    return Math.max(SPAN, RELATIVE_SPAN * this.distance);
  }

  line(ctx, see, a, b) { // in pieces, so that one behind the camera hides only itself
    const from = see(a), to = see(b);
    if (!from || !to) return;
    ctx.beginPath();
    ctx.moveTo(from[0], from[1]);
    ctx.lineTo(to[0], to[1]);
    ctx.stroke();
  }

  lowest(pose) { // altitude of the lowest row, m; looks at new rows only
    if (!pose) return 0;
    if (this.seen?.pose !== pose) this.seen = {pose, count: 0, lowest: Infinity};
    const altitude = pose.column("altitude");
    for (; altitude && this.seen.count < pose.count; this.seen.count++) {
      if (altitude[this.seen.count] < this.seen.lowest) this.seen.lowest = altitude[this.seen.count];
    }
    return this.seen.lowest < Infinity ? this.seen.lowest : 0;
  }

  earth(ctx, eye, focal, width, height, colour) { // from the horizon down; the camera does not roll
    const level = unit([eye.ahead[0], eye.ahead[1], 0]), horizon = height / 2 + focal * dot(level, eye.down) / dot(level, eye.ahead);
    ctx.fillStyle = colour("--earth");
    ctx.fillRect(0, horizon, width, Math.max(height - horizon, 0));
  }

  grid(ctx, see, {place}, flight, colour) { // below the lowest point, with a line down to it
    const step = 10 ** Math.floor(Math.log10(0.8 * this.distance)), ground = Math.floor((this.lowest(flight.get("pose")) - 5) / 10) * 10;
    const [north, east] = [Math.round(place[0] / step) * step, Math.round(place[1] / step) * step];
    ctx.strokeStyle = colour("--grid");
    ctx.lineWidth = 1;
    for (let k = -8; k <= 8; k++) {
      for (let j = -8; j < 8; j++) {
        this.line(ctx, see, [north + k * step, east + j * step, -ground], [north + k * step, east + (j + 1) * step, -ground]);
        this.line(ctx, see, [north + j * step, east + k * step, -ground], [north + (j + 1) * step, east + k * step, -ground]);
      }
    }
    ctx.setLineDash([2, 4]);
    ctx.strokeStyle = colour("--quiet");
    this.line(ctx, see, place, [place[0], place[1], -ground]);
    ctx.setLineDash([]);
    this.legend = !flight.get("pose") ? "no pose in the log: attitude of truth, no place" : `grid ${step} m, ground drawn at ${ground} m`;
  }

  route(ctx, see, flight, pose, colour) {
    const points = flight.info.route ?? [];
    ctx.strokeStyle = colour("--reference");
    ctx.lineWidth = 2;
    for (let k = 1; k < points.length; k++) {
      const at = ([north, east, altitude]) => [north, east, altitude === null ? pose.place[2] : -altitude];
      this.line(ctx, see, at(points[k - 1]), at(points[k]));
    }
  }

  trail(ctx, see, flight, t, colourOf, width) { // the whole path; what lies ahead of the cursor is thin
    const pose = flight.get("pose");
    if (!pose || !pose.column("north")) return;
    const [north, east, altitude] = ["north", "east", "altitude"].map(name => pose.column(name));
    const now = indexAt(pose.t, pose.count, t), step = Math.max(1, Math.ceil(pose.count / MAX_TRAIL)), internals = flight.get("internals");
    let before = null, key = "", last = 0;
    for (let k = 0; k < pose.count + step - 1; k += step) {
      const row = Math.min(k, pose.count - 1);
      if (before && pose.hasGap?.(last, row)) {
        ctx.stroke();
        before = null;
      }
      last = row;
      const point = see([north[row], east[row], -(altitude?.[row] ?? 0)]);
      const mode = internals ? internals.at("mode", pose.t[row]) : NaN, style = `${mode} ${row <= now}`;
      if (style !== key && before) ctx.stroke();
      if (style !== key || !point || !before) {
        ctx.strokeStyle = colourOf(mode);
        ctx.lineWidth = row <= now ? 2.2 * width : 0.8 * width;
        ctx.beginPath();
        if (before) ctx.moveTo(before[0], before[1]);
        key = style;
      }
      if (point && before) ctx.lineTo(point[0], point[1]);
      else if (point) ctx.moveTo(point[0], point[1]);
      else if (before) ctx.stroke();
      before = point;
    }
    if (before) ctx.stroke();
  }

  aircraft(ctx, see, pose, surfaces, colour, alpha) {
    if (!pose.attitude) {
      const at = see(pose.place);
      if (at) {
        ctx.fillStyle = colour("--plant");
        ctx.fillRect(at[0] - 4, at[1] - 4, 8, 8);
      }
      return;
    }
    const matrix = rotation(pose.phi, pose.theta, pose.psi), light = unit([0.3, -0.4, -1]);
    const polygons = aircraft(surfaces).map(({part, points}) => {
      const world = points.map(point => plus(pose.place, toWorld(matrix, point), this.span));
      const normal = unit(cross(plus(world[1], world[0], -1), plus(world[2], world[0], -1)));
      const seen = world.map(see);
      return {part, seen, shade: 0.62 + 0.38 * Math.abs(dot(normal, light)), depth: seen.reduce((sum, one) => sum + (one ? one[2] : NaN), 0) / seen.length};
    });
    ctx.globalAlpha = alpha;
    for (const {part, seen, shade} of polygons.filter(one => one.depth > 0).sort((a, b) => b.depth - a.depth)) {
      ctx.beginPath();
      seen.forEach(([x, y], k) => (k ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
      ctx.closePath();
      ctx.fillStyle = shaded({body: [120, 135, 150], wing: [190, 202, 212], surface: [246, 140, 60]}[part], shade);
      ctx.strokeStyle = shaded([70, 80, 90], shade);
      ctx.lineWidth = 0.6;
      ctx.fill();
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
  }

  wind(ctx, see, flight, pose, t, colour) { // the wind along the body axes, from the tip of the arrow at the aircraft
    const truth = flight.get("truth");
    const gust = ["longitudinal", "lateral", "vertical"].map(name => truth?.at(`gust.${name}`, t)).map(value => (Number.isFinite(value) ? value : 0));
    if (!pose.attitude || Math.hypot(...gust) < 0.05) return;
    const along = toWorld(rotation(pose.phi, pose.theta, pose.psi), gust);
    ctx.strokeStyle = colour("--bad");
    ctx.lineWidth = 3;
    const start = plus(pose.place, along, -this.span / MAX_WIND);
    this.line(ctx, see, start, pose.place);
    ctx.fillStyle = colour("--bad");
    ctx.font = "12px system-ui, sans-serif";
    ctx.textAlign = "left";
    ctx.fillText(`wind ${Math.hypot(...gust).toFixed(1)} m/s`, MARK, MARK + 6);
  }
}

const shaded = (rgb, shade) => `rgb(${rgb.map(value => Math.round(value * shade)).join(" ")})`;

// The artificial horizon. Nose up moves the horizon down, roll right turns it to the left.
export function drawHorizon(canvas, pose, colour) {
  const {ctx, width, height} = prepared(canvas), radius = Math.min(width, height) / 2 - 2, scale = radius / (35 * Math.PI / 180);
  ctx.translate(width / 2, height / 2);
  ctx.save();
  ctx.beginPath();
  ctx.arc(0, 0, radius, 0, 2 * Math.PI);
  ctx.clip();
  ctx.fillStyle = colour("--panel");
  ctx.fillRect(-radius, -radius, 2 * radius, 2 * radius);
  if (pose?.attitude) drawLadder(ctx, pose, radius, scale, colour);
  ctx.restore();
  ctx.textAlign = "center";
  ctx.font = "600 12px system-ui, sans-serif";
  if (!pose?.attitude) {
    ctx.fillStyle = colour("--warn");
    ctx.fillText("NO ATTITUDE", 0, 4);
    return;
  }
  ctx.strokeStyle = "#ffcf33";
  ctx.lineWidth = 3;
  ctx.beginPath();
  ctx.moveTo(-radius * 0.45, 0); ctx.lineTo(-radius * 0.15, 0); ctx.lineTo(0, radius * 0.08); ctx.lineTo(radius * 0.15, 0); ctx.lineTo(radius * 0.45, 0);
  ctx.stroke();
  ctx.fillStyle = "#ffcf33";
  ctx.beginPath(); // the roll index
  ctx.moveTo(0, -radius + 12); ctx.lineTo(-5, -radius + 22); ctx.lineTo(5, -radius + 22);
  ctx.fill();
}

function drawLadder(ctx, {phi, theta}, radius, scale, colour) {
  ctx.save();
  ctx.rotate(-phi);
  ctx.save();
  ctx.translate(0, theta * scale);
  ctx.fillStyle = colour("--sky");
  ctx.fillRect(-3 * radius, -12 * radius, 6 * radius, 12 * radius);
  ctx.fillStyle = colour("--ground");
  ctx.fillRect(-3 * radius, 0, 6 * radius, 12 * radius);
  ctx.strokeStyle = ctx.fillStyle = "#fff";
  ctx.font = "10px system-ui, sans-serif";
  ctx.textBaseline = "middle";
  for (let degrees = -80; degrees <= 80; degrees += 5) {
    const y = -degrees * Math.PI / 180 * scale, half = radius * (degrees === 0 ? 2 : degrees % 10 ? 0.12 : 0.25);
    ctx.lineWidth = degrees === 0 ? 2 : 1;
    ctx.beginPath();
    ctx.moveTo(-half, y);
    ctx.lineTo(half, y);
    ctx.stroke();
    if (degrees && degrees % 10 === 0) ctx.fillText(`${Math.abs(degrees)}`, half + 10, y);
  }
  ctx.restore();
  ctx.strokeStyle = "#fff";
  for (const degrees of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) { // the roll scale
    const angle = degrees * Math.PI / 180, inner = degrees % 30 ? radius - 7 : radius - 11;
    ctx.lineWidth = degrees === 0 ? 3 : 1.5;
    ctx.beginPath();
    ctx.moveTo(Math.sin(angle) * radius, -Math.cos(angle) * radius);
    ctx.lineTo(Math.sin(angle) * inner, -Math.cos(angle) * inner);
    ctx.stroke();
  }
  ctx.restore();
}

// Charts over time on canvases: lines decimated to the minimum and maximum of each pixel, bands, limits, one cursor.
import {MODE_COLOURS, prepared} from "./canvas.js";
import {ON_ROUTE} from "./scene.js";
import {indexAt} from "./series.js";
import {fixed} from "./units.js";

const LEFT = 58, RIGHT = 10, LINE = 15, BOTTOM = 4;
const NARROW = 500; // px, width below which the readouts have a line of their own
const SHOWN = 0.01; // of the extent of a chart: about the last digit of a readout
const MOST_DIGITS = 6; // behind the point
const LEAST_SPEED = 0.5; // m/s beyond the airspeeds in view, so that noise does not fill the chart
const RESOLUTION = {ms: 1e-3, deg: 1e-4, "m/s": 1e-4, m: 1e-3, "deg/s": 1e-3, "rad/s": 1e-6}; // by unit, the least extent of a chart
const LIMIT_VIEW_RATIO = 3; // a limit is in view where it is at most this many times the largest value

// Ticks at multiples of 1, 2 or 5 times a power of ten, at most `most` of them.
export function ticks(low, high, most) {
  const raw = (high - low) / most, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(digit => digit * power).find(one => one >= raw * 0.999);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
  const text = value => (digits > 4 ? (value === 0 ? "0" : value.toExponential(1)) : value.toFixed(digits));
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push({value: k * step, text: text(k * step)});
  return found;
}

// A number as a readout: with the digits behind the point that a chart of this extent shows, so that it keeps its width; "-" without a value.
export function readout(value, largest) {
  if (!Number.isFinite(value)) return "-";
  const digits = largest > 0 ? Math.round(-Math.log10(SHOWN * largest)) : 0;
  return fixed(value, Math.min(Math.max(digits, 0), MOST_DIGITS));
}

// Rows of a series to draw between two times: all, or the rows of the minimum and the maximum of each of `bins` bins; a gap ends a bin.
export function rows(series, column, [from, to], bins) {
  const first = Math.max(indexAt(series.t, series.count, from), 0), last = Math.min(indexAt(series.t, series.count, to) + 2, series.count);
  const width = Math.ceil((last - first) / bins), found = [];
  if (width <= 2) {
    for (let k = first; k < last; k++) found.push(k);
    return found;
  }
  let next = first;
  for (const before of series.gaps) {
    if (before < first || before >= last - 1) continue;
    binned(column, next, before + 1, width, found);
    next = before + 1;
  }
  binned(column, next, last, width, found);
  return found;
}

function binned(column, first, last, width, found) { // the rows of the minimum and the maximum of each bin
  for (let begin = first; begin < last; begin += width) {
    let low = begin, high = begin;
    for (let k = begin; k < Math.min(begin + width, last); k++) {
      if (!(column[k] >= column[low])) low = k;
      if (!(column[k] <= column[high])) high = k;
    }
    found.push(Math.min(low, high));
    if (low !== high) found.push(Math.max(low, high));
  }
}

function timed(flight, name) { // topics of the controller where it has engaged, else those of the aircraft
  const internals = flight.get("internals");
  return internals && internals.count && internals.column(name) ? ["internals", name] : [name.split(".")[0], name.split(".").slice(1).join(".")];
}

// The channels that a chart may show, "topic/channel".
export function channelsOf(flight) {
  return [...flight.series].flatMap(([topic, series]) => series.channels.map(channel => `${topic}/${channel}`)).sort();
}

const COLOURS = ["--plant", "--error", "--ghost", "--reference"];

// A chart of channels that the user has chosen.
export function chartOf(flight, channels) {
  const {units} = flight.info;
  const known = name => units[name.slice(name.indexOf("/") + 1).replace(/^(y|y_m|e|u|u_free|actuator)\./, "")] ?? {unit: "", factor: 1};
  const [unit] = channels.map(name => known(name).unit);
  const lines = channels.map((name, k) => {
    const [topic, channel] = [name.slice(0, name.indexOf("/")), name.slice(name.indexOf("/") + 1)];
    return {flight, topic, channel, label: name, colour: COLOURS[k % COLOURS.length], width: 1.4, offset: 0, factor: known(name).unit === unit ? known(name).factor : 1};
  });
  return {title: channels.join(", "), unit: channels.every(name => known(name).unit === unit) ? unit : "", lines, channels};
}

// The charts of a flight, by what its log holds; `ghost` is the second flight or null.
export function chartsOf(flight, ghost) {
  const {units, limits} = flight.info;
  const unit = name => units[name] ?? {unit: "", factor: 1};
  const line = (topic, channel, label, colour, width, more = {}) => ({flight, topic, channel, label, colour, width, factor: 1, offset: 0, ...more});
  const charts = guidanceCharts(flight, line), first = []; // a pilot's charts, altitude and speed
  if (flight.get("pose")?.channels.includes("altitude")) {
    const lines = [line("pose", "altitude", "altitude", "--plant", 1.4)];
    if (flight.get("guidance")?.channels.includes("target.altitude")) lines.unshift(line("guidance", "target.altitude", "command", "--reference", 4));
    if (ghost) lines.unshift(line("pose", "altitude", "of the ghost", "--ghost", 1.2, {flight: ghost, dash: [5, 3]}));
    first.push({title: "altitude", unit: "m", lines});
  }
  const names = group => flight.get("internals")?.group(group) ?? [];
  const outputs = names("y").length ? names("y") : flight.get("y")?.channels ?? [];
  for (const name of outputs) {
    const isSpeed = name === "V", factor = unit(name).factor;
    const offset = (isSpeed && flight.info.speed) || 0; // y is about trim, and a pilot reads the airspeed itself, as on the tape
    const lines = [
      line(...timed(flight, `y_m.${name}`), "y_m", "--reference", 4, {factor, offset}),
      line(...timed(flight, `y.${name}`), "y", "--plant", 1.4, {factor, offset}),
    ];
    if (ghost) lines.splice(1, 0, line(...timed(ghost, `y.${name}`), "y of the ghost", "--ghost", 1.2, {factor, offset, flight: ghost, dash: [5, 3]}));
    const referenced = names("y_m").length || flight.get("y_m");
    (isSpeed ? first : charts).push({title: referenced ? `${name}: y over y_m` : name, unit: unit(name).unit, lines, least: isSpeed ? LEAST_SPEED : 0});
  }
  for (const name of names("e")) {
    const {factor, unit: text} = unit(name), band = flight.head.bands[name];
    const lines = [line("internals", `e.${name}`, "e", "--error", 1.2, {factor})];
    if (ghost) lines.unshift(line("internals", `e.${name}`, "e of the ghost", "--ghost", 1, {factor, flight: ghost, dash: [5, 3]}));
    charts.push({title: `${name}: error e`, unit: text, lines, band: band ? band * factor : undefined});
  }
  for (const name of names("u").length ? names("u") : flight.get("u")?.channels ?? []) {
    const {factor, unit: text} = unit(name), lines = [];
    if (names("u_free").includes(name)) lines.push(line("internals", `u_free.${name}`, "before limits", "--free", 1, {factor}));
    lines.push(line(...timed(flight, `u.${name}`), "u", "--reference", 2.6, {factor, steps: true}));
    if (flight.get("truth")?.channels.includes(`actuator.${name}`)) lines.push(line("truth", `actuator.${name}`, "actuator", "--plant", 1.2, {factor}));
    const bounds = (limits[name] ?? []).filter(bound => bound !== null).map(bound => bound * factor);
    charts.push({title: name, unit: text, lines, limits: bounds, saturation: `limited.${name}`});
  }
  for (const name of flight.info.learned) { // an entry of A or B, with the band of two deviations
    const lines = [line("learned", `value.${name}`, name, "--plant", 1.4, {deviation: `deviation.${name}`})];
    charts.push({title: `${name}, learned`, unit: "SI", lines});
  }
  const winds = flight.get("truth")?.group("gust") ?? [];
  if (winds.length) {
    const colours = ["--plant", "--ghost", "--error"];
    charts.push({title: "wind", unit: "m/s", lines: winds.map((name, k) => line("truth", `gust.${name}`, name, colours[k % 3], 1.2))});
  }
  if (flight.get("internals")?.column("late")) {
    charts.push({title: "ticks: lateness", unit: "ms", lines: [line("internals", "late", "late", "--plant", 1, {factor: 1e3})]});
  }
  return [...first, ...charts];
}

function guidanceCharts(flight, line) { // attitude over its command, and the distance from the path, of a guided flight
  const guidance = flight.get("guidance");
  if (!guidance) return [];
  const degrees = 180 / Math.PI, charts = [];
  for (const name of ["phi", "theta"]) {
    if (!guidance.channels.includes(`${name}_c`)) continue;
    const lines = [line("guidance", `${name}_c`, "command", "--reference", 4, {factor: degrees})];
    if (flight.get("pose")?.channels.includes(name)) lines.push(line("pose", name, name, "--plant", 1.4, {factor: degrees}));
    charts.push({title: `${name} over its command`, unit: "deg", lines});
  }
  if (guidance.channels.includes("wind.north")) {
    const lines = [["north", "--plant"], ["east", "--error"]].map(([side, colour]) => line("guidance", `wind.${side}`, `from the ${side}`, colour, 1.4, {factor: -1})); // as pilots say it
    charts.push({title: "wind, estimated", unit: "m/s", lines});
  }
  if (guidance.channels.includes("xtrack")) charts.push({title: "cross-track", unit: "m", lines: [line("guidance", "xtrack", "cross-track", "--error", 1.2)]});
  return charts;
}

function extent(chart, view, bins) { // the decimated lines, and the least and largest value in view
  let low = Infinity, high = -Infinity;
  const drawn = [];
  for (const line of chart.lines) {
    const series = line.flight.get(line.topic), column = series?.column(line.channel);
    if (!column || !series.count) continue;
    const chosen = rows(series, column, view, bins), deviation = series.column(line.deviation);
    for (const k of chosen) {
      const value = column[k] * line.factor + line.offset, spread = deviation ? 2 * deviation[k] : 0;
      if ((deviation || series.t[k] >= view[0] - 1) && Number.isFinite(value + spread)) { low = Math.min(low, value - spread); high = Math.max(high, value + spread); }
    }
    drawn.push({line, series, column, chosen});
  }
  if (low > high) [low, high] = [-1, 1];
  const largest = Math.max(Math.abs(low), Math.abs(high));
  for (const bound of chart.limits ?? []) {
    if (Math.abs(bound) <= LIMIT_VIEW_RATIO * largest) { low = Math.min(low, bound); high = Math.max(high, bound); }
  }
  if (chart.band && chart.band <= 3 * largest) { low = Math.min(low, -chart.band); high = Math.max(high, chart.band); }
  const pad = Math.max((high - low) * 0.08, Math.abs(high) * 1e-3, chart.least ?? 0, RESOLUTION[chart.unit] ?? 1e-9);
  return {drawn, low: low - pad, high: high + pad};
}

export const timeAt = (canvas, x, [from, to]) => from + ((x - LEFT) / (canvas.clientWidth - LEFT - RIGHT)) * (to - from);

// Draw one chart. `flight` gives the gusts; `selection` is a pair of times or null, `pointer` the time under the pointer or null.
export function drawChart(canvas, chart, flight, view, cursor, {selection, pointer}, colour) {
  const {ctx, width, height} = prepared(canvas), [from, to] = view, right = width - RIGHT, bottom = height - BOTTOM;
  const top = width < NARROW ? 2 * LINE + 2 : LINE + 2;
  const {drawn, low, high} = extent(chart, view, right - LEFT);
  const x = t => LEFT + ((t - from) / (to - from)) * (right - LEFT), y = value => bottom - ((value - low) / (high - low)) * (bottom - top);
  ctx.font = "11px system-ui, sans-serif";
  ctx.save();
  ctx.beginPath();
  ctx.rect(LEFT, top, right - LEFT, bottom - top);
  ctx.clip();
  ctx.fillStyle = colour("--gust");
  for (const [, start, stop] of flight.info.gusts) ctx.fillRect(x(start), top, x(stop) - x(start), bottom - top);
  if (chart.band) {
    ctx.fillStyle = colour("--band");
    ctx.fillRect(LEFT, y(chart.band), right - LEFT, y(-chart.band) - y(chart.band));
  }
  ctx.strokeStyle = colour("--line");
  ctx.lineWidth = 1;
  const marks = ticks(low, high, 5);
  for (const {value} of marks) stroke(ctx, [[LEFT, y(value)], [right, y(value)]]);
  for (const {value} of ticks(from, to, Math.max(width / 110, 2))) stroke(ctx, [[x(value), top], [x(value), bottom]]);
  ctx.strokeStyle = colour("--limit");
  ctx.setLineDash([6, 4]);
  for (const bound of chart.limits ?? []) stroke(ctx, [[LEFT, y(bound)], [right, y(bound)]]);
  for (const {line, series, column, chosen} of drawn) {
    if (line.deviation) {
      drawLearned(ctx, line, series, column, chosen, x, y, Math.min(right, x(flight.end)), colour);
      continue;
    }
    ctx.strokeStyle = colour(line.colour);
    ctx.lineWidth = line.width;
    ctx.lineJoin = "round";
    ctx.setLineDash(line.dash ?? []);
    ctx.beginPath();
    let pen = false, before = chosen[0];
    for (const k of chosen) {
      const value = column[k] * line.factor + line.offset;
      if (series.hasGap(before, k)) pen = false;
      before = k;
      if (!Number.isFinite(value)) { pen = false; continue; }
      if (pen && line.steps) ctx.lineTo(x(series.t[k]), y(column[k - 1] * line.factor + line.offset));
      if (pen) ctx.lineTo(x(series.t[k]), y(value)); else ctx.moveTo(x(series.t[k]), y(value));
      pen = true;
    }
    ctx.stroke();
  }
  ctx.setLineDash([]);
  drawSaturation(ctx, chart, flight, view, x, top);
  if (selection) {
    ctx.fillStyle = colour("--gust");
    ctx.fillRect(x(selection[0]), top, x(selection[1]) - x(selection[0]), bottom - top);
  }
  ctx.strokeStyle = colour("--ink");
  ctx.lineWidth = 1;
  stroke(ctx, [[x(cursor), top], [x(cursor), bottom]]);
  if (pointer !== null) {
    ctx.setLineDash([2, 3]);
    stroke(ctx, [[x(pointer), top], [x(pointer), bottom]]);
    ctx.setLineDash([]);
  }
  ctx.restore();
  ctx.fillStyle = colour("--quiet");
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  for (const {value, text} of marks) ctx.fillText(text, LEFT - 5, y(value));
  drawTitle(ctx, chart, drawn, [cursor, pointer], [low, high], width, colour);
}

function drawLearned(ctx, line, series, column, chosen, x, y, end, colour) { // a value until the next identification; dashed where no model was proposed
  const deviation = series.column(line.deviation), proposed = series.column("proposed");
  ctx.lineWidth = line.width;
  for (const k of chosen) {
    const start = x(series.t[k]), stop = k + 1 < series.count ? x(series.t[k + 1]) : Math.max(end, start + 2), spread = 2 * deviation[k];
    ctx.fillStyle = colour("--band");
    ctx.fillRect(start, y(column[k] + spread), stop - start, y(column[k] - spread) - y(column[k] + spread));
    ctx.strokeStyle = colour(line.colour);
    ctx.setLineDash(proposed?.[k] > 0 ? [] : [5, 3]);
    stroke(ctx, [[start, y(column[k])], [stop, y(column[k])]]);
  }
}

function stroke(ctx, points) {
  ctx.beginPath();
  points.forEach(([x, y], k) => (k ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.stroke();
}

function drawSaturation(ctx, chart, flight, view, x, top) { // marks where the controller saturated the input
  const series = flight.get("internals"), column = chart.saturation && series?.column(chart.saturation);
  if (!column) return;
  for (const k of rows(series, column, view, 2000)) {
    if (!(column[k] > 0)) continue;
    ctx.fillStyle = column[k] === 1 ? "#d62728" : "#8a63b8";
    ctx.fillRect(x(series.t[k]) - 0.5, top, 2, 4);
  }
}

// The title, and the values of each line: at the cursor, and at the pointer where there is one.
function drawTitle(ctx, chart, drawn, [cursor, pointer], [low, high], width, colour) {
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  ctx.fillStyle = colour("--ink");
  ctx.font = "600 11px system-ui, sans-serif";
  const title = chart.unit ? `${chart.title} (${chart.unit})` : chart.title;
  const narrow = width < NARROW, level = narrow ? 2 * LINE - 3 : LINE - 3, size = ctx.measureText(title).width;
  ctx.fillText(title, LEFT, LINE - 3);
  ctx.font = "11px system-ui, sans-serif";
  const texts = drawn.map(({line, series}) => {
    const at = t => readout(series.shown(line.channel, t) * line.factor + line.offset, high - low);
    const spread = line.deviation ? ` +- ${(2 * series.at(line.deviation, cursor)).toPrecision(2)}` : "";
    return `${line.label} ${at(cursor)}${spread}${pointer === null ? "" : ` | ${at(pointer)}`}`;
  });
  const wide = texts.reduce((sum, text) => sum + ctx.measureText(text).width + 22, 0);
  const scale = Math.min(1, (width - RIGHT - (narrow ? 0 : LEFT + size + 8)) / wide); // closer letters where the values need more
  ctx.textAlign = "right";
  let place = width - RIGHT;
  for (const [k, text] of [...texts.entries()].reverse()) {
    const long = ctx.measureText(text).width * scale;
    ctx.fillStyle = colour("--ink");
    ctx.fillText(text, place, level, long);
    ctx.fillStyle = colour(drawn[k].line.colour);
    ctx.fillRect(place - long - 12 * scale, level - 5, 8 * scale, 4);
    place -= long + 22 * scale;
  }
}

// The axis of time under the charts, for the view.
export function drawAxis(canvas, [from, to], cursor, colour) {
  const {ctx, width, height} = prepared(canvas), x = t => LEFT + ((t - from) / (to - from)) * (width - LEFT - RIGHT);
  ctx.strokeStyle = ctx.fillStyle = colour("--quiet");
  ctx.font = "11px system-ui, sans-serif";
  ctx.textBaseline = "alphabetic";
  stroke(ctx, [[LEFT, 0.5], [width - RIGHT, 0.5]]);
  for (const {value, text} of ticks(from, to, Math.max(width / 110, 2))) {
    stroke(ctx, [[x(value), 0], [x(value), 4]]);
    ctx.textAlign = x(value) > width - 2 * RIGHT ? "right" : "center";
    ctx.fillText(`${text} s`, Math.min(x(value), width), height - 2);
  }
  if (cursor >= from && cursor <= to) {
    ctx.fillStyle = colour("--ink");
    ctx.fillRect(x(cursor) - 1, 0, 2, 6);
  }
}

// The timeline: the mode of the controller over the whole flight, gusts, events, the view and the cursor.
// Returns the numbers of the modes on it.
export function drawTimeline(canvas, flight, [from, to], view, cursor, colour) {
  const found = new Set(), {ctx, width, height} = prepared(canvas), x = t => LEFT + ((t - from) / (to - from)) * (width - LEFT - RIGHT);
  const strip = height - 22;
  const internals = flight.get("internals"), modes = internals?.column("mode");
  ctx.fillStyle = colour("--panel");
  ctx.fillRect(x(from), 4, x(to) - x(from), strip);
  if (modes) {
    const chosen = rows(internals, modes, [from, to], width);
    for (let first = 0, k = 1; k <= chosen.length; k++) {
      if (k < chosen.length && modes[chosen[k]] === modes[chosen[first]]) continue;
      const start = x(internals.t[chosen[first]]), stop = x(internals.t[chosen[Math.min(k, chosen.length - 1)]]);
      found.add(modes[chosen[first]]);
      ctx.fillStyle = modeColour(modes[chosen[first]]);
      ctx.fillRect(start, 4, Math.max(stop - start, 1.5), strip);
      first = k;
    }
  }
  ctx.fillStyle = colour("--gust");
  for (const [, start, stop] of flight.info.gusts) if (start < to) ctx.fillRect(x(start), 4, Math.max(x(Math.min(stop, to)) - x(start), 2), strip);
  ctx.fillStyle = colour("--ink");
  for (const [, start] of flight.info.commands) if (start < to) ctx.fillRect(x(start), 4 + strip - 5, 1.5, 5);
  for (const {t, kind} of flight.events) {
    if (t < from || t > to) continue;
    ctx.fillStyle = kind === "error" ? colour("--bad") : kind === "warning" ? colour("--warn") : colour("--ink");
    ctx.fillRect(x(t) - 0.75, 1, 1.5, 7);
  }
  drawLegs(ctx, flight, [from, to], x, strip, colour);
  ctx.strokeStyle = colour("--ink");
  ctx.lineWidth = 1;
  ctx.strokeRect(x(Math.max(view[0], from)), 3.5, x(Math.min(view[1], to)) - x(Math.max(view[0], from)), strip + 1);
  ctx.fillStyle = colour("--ink");
  ctx.fillRect(x(cursor) - 1, 0, 2, strip + 8);
  ctx.fillStyle = colour("--quiet");
  ctx.font = "11px system-ui, sans-serif";
  ctx.textBaseline = "alphabetic";
  for (const {value, text} of ticks(from, to, Math.max(width / 90, 2))) {
    ctx.textAlign = x(value) < 12 ? "left" : x(value) > width - 12 ? "right" : "center";
    ctx.fillText(`${text} s`, x(value), height - 4);
  }
  return [...found].sort();
}

export const modeColour = mode => MODE_COLOURS[mode] ?? "#d62728";

function drawLegs(ctx, flight, [from, to], x, strip, colour) { // where a leg of the route begins, with its number where there is room
  const series = flight.get("guidance"), [legs, lateral] = ["leg", "mode.lateral"].map(name => series?.column(name));
  if (!legs || !lateral) return;
  ctx.fillStyle = colour("--ink");
  ctx.font = "10px system-ui, sans-serif";
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  let before = -1, free = -Infinity;
  for (let k = 0; k < series.count; k++) {
    const leg = lateral[k] === ON_ROUTE ? legs[k] : -1, place = x(series.t[k]);
    if (leg === before) continue;
    before = leg;
    if (series.t[k] < from || series.t[k] > to || leg < 0) continue;
    ctx.fillRect(place, 4 + strip / 2, 1, strip / 2);
    if (place < free) continue;
    ctx.fillText(`${leg}`, place + 3, 4 + strip - 2);
    free = place + 6 + ctx.measureText(`${leg}`).width;
  }
}

export const timelineTime = timeAt; // it lies under the charts

// The page: asks the server for news, keeps the time and the view, draws what has changed.
import {MODE_COLOURS} from "./canvas.js";
import {chartsOf, drawAxis, drawChart, drawTimeline, modeColour, timeAt, timelineTime} from "./charts.js";
import * as choice from "./choice.js";
import {flyTo, offer, togglesFlyTo} from "./control.js";
import {Flight} from "./data.js";
import {drawHorizon, poseAt, Scene} from "./scene.js";
import {indexAt} from "./series.js";
import {drawHeading, drawTape} from "./tapes.js";
import {distanceText, shownAs, UNITS, windText} from "./units.js";

const SPEEDS = [0.1, 0.2, 0.5, 1, 2, 5, 10];
const WINDOW = 20; // s
const SILENT = 1000; // ms without a sample after which a recording says "no data"
const RETRY = 500; // ms between two requests to a server that does not answer
const FAILSAFES = {"": ["HOLD", "RAMP", "TRIM"], mode: ["DEAD_RECKONING", "POSE_LOST"]}; // modes of the controller and of guidance
const HEADINGS = {HEADING: "target.heading", COURSE: "target.course"}; // what the heading tape shows as the command
const SPANS = {speed: 0.5, height: 200}; // of the tapes: of the airspeed itself, and of the altitude, m
const BADGES = {CONNECTING: "", WAITING: "warn", READING: "", LIVE: "good", "NO DATA": "bad", "NO SERVER": "bad", INTERRUPTED: "warn", ENDED: ""};

const ADDRESS = new URLSearchParams(location.hash.slice(1)); // that may end with #aircraft=2&t=12.5
const ASKED = parseFloat(ADDRESS.get("t")); // s

const $ = id => document.getElementById(id);
const flight = new Flight(Number(ADDRESS.get("aircraft") ?? 0));
let ghost = null, fleet = null, charts = [], chartKey = "", colours = {}, dirty = true, shownEvents = -1;
const clock = {t: 0, playing: false, speed: 1, live: true, started: false};
const view = {kind: "window", from: 0, to: WINDOW};
const link = {serving: false, refusal: "", samples: 0}; // the server answers; why it refuses; when, in ms, the last answer with samples came
const scene = new Scene($("scene"), redraw, flyTo);
let cameraChosen = false; // by the user; until then a guided flight shows its map

// ---- Colours of the scheme

const colour = name => (colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colours = {}; redraw(); });

function redraw() {
  dirty = true;
}

// ---- Samples

async function follow(one) {
  for (;;) {
    try {
      const came = await one.poll();
      if (one === flight) {
        link.serving = true;
        link.refusal = "";
        if (came) link.samples = performance.now();
      }
      taken();
    } catch (error) {
      if (one === flight) {
        link.serving = false;
        link.refusal = error.name === "Error" ? error.message : "";
      }
      await new Promise(resume => setTimeout(resume, RETRY));
    }
    redraw();
    await drawn(); // nothing queues: the next answer is asked for once this one is on the screen
  }
}

const drawn = () => Promise.race([new Promise(requestAnimationFrame), new Promise(resume => setTimeout(resume, RETRY))]);

function taken() { // a recording is followed at its end; a log that has ended starts at its beginning
  const recording = ["recording", "no data"].includes(flight.head.state);
  if (!clock.started && flight.end > -Infinity) {
    clock.started = flight.head.state !== "reading";
    if (!cameraChosen && (flight.get("guidance") || flight.head.fleet) && flight.get("pose")?.column("north")) scene.show("map");
    clock.live = recording;
    view.kind = recording ? "window" : "whole";
    if (!recording) seek(Number.isFinite(ASKED) ? ASKED : begin());
  }
  if (clock.live) {
    clock.t = flight.end > -Infinity ? flight.end : 0;
    clock.live = flight.head.state !== "ended";
  }
  if (flight.head.control) offer();
  if (flight.head.ghost && !ghost) {
    ghost = new Flight(1);
    follow(ghost);
  }
  if (flight.head.fleet && !fleet) {
    fleet = new Flight(flight.head.fleet);
    follow(fleet);
  }
  if (fleet) offerAircraft();
}

// ---- Fleet

const aircraftOfFleet = () => fleet?.info.aircraft ?? []; // [name, flight time 0 by the clock of the stamps] each

function offerAircraft() {
  const names = aircraftOfFleet().map(([name]) => name), node = $("aircraft");
  $("choice").hidden = !names.length;
  if (node.dataset.shown === names.join("\n")) return;
  node.dataset.shown = names.join("\n");
  node.replaceChildren(...names.map((name, k) => new Option(name, k, false, k === flight.number)));
}

function choose(number) { // the page begins again with another aircraft, at the same instant
  const t = clock.t + flight.head.start - aircraftOfFleet()[number][1];
  location.hash = new URLSearchParams(clock.live ? {aircraft: number} : {aircraft: number, t});
  location.reload();
}

function others() { // what the scene draws beside the flight: the ghost, or the other aircraft, of which the page has the poses
  if (ghost) return [{flight: ghost, name: "", t: clock.t}];
  const t = clock.t + flight.head.start - (fleet?.head.start ?? 0);
  const poses = k => ({get: topic => (topic === "pose" ? fleet.get(`${k}`) : undefined), info: {units: {}, positive: {}}});
  return aircraftOfFleet().map(([name], k) => ({flight: poses(k), name, t})).filter((_, k) => k !== flight.number);
}

const begin = () => (flight.begin < Infinity ? flight.begin : 0);
const end = () => (flight.end > -Infinity ? flight.end : WINDOW);

function status() {
  const {state} = flight.head;
  if (!link.serving) return link.samples || state ? "NO SERVER" : "CONNECTING";
  if (state === "ended") return "ENDED";
  if (state === "interrupted") return "INTERRUPTED";
  if (state === "waiting" || state === "reading") return state.toUpperCase();
  return state === "no data" || performance.now() - link.samples > SILENT ? "NO DATA" : "LIVE";
}

// ---- Time

function seek(t) {
  clock.t = Math.min(Math.max(t, begin()), end());
  clock.live = clock.t >= end() && flight.head.state === "recording";
  if (clock.live) clock.playing = false;
  redraw();
}

function step(direction, big) {
  clock.playing = false;
  const ticks = flight.get("internals") ?? flight.get("y") ?? flight.get("pose");
  if (big || !ticks) return seek(clock.t + direction);
  const row = Math.min(Math.max(indexAt(ticks.t, ticks.count, clock.t) + direction, 0), ticks.count - 1);
  seek(ticks.t[row]);
}

const instants = () => [...flight.events.map(({t}) => t), ...flight.info.gusts.map(gust => gust[1]), ...flight.info.commands.map(command => command[1])]
  .filter(t => t >= begin() && t <= end()).sort((a, b) => a - b);

function jump(direction) {
  const times = instants(), found = direction > 0 ? times.find(t => t > clock.t + 1e-6) : times.reverse().find(t => t < clock.t - 1e-6);
  if (found !== undefined) { clock.playing = false; seek(found); }
}

function play() {
  if (clock.t >= end() && !clock.live) clock.t = begin();
  clock.playing = clock.live ? false : !clock.playing;
  clock.live = false;
  redraw();
}

function live() {
  clock.live = true;
  clock.playing = false;
  clock.t = end();
  view.kind = "window";
  redraw();
}

function setSpeed(index) {
  clock.speed = SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)];
  $("speed").value = clock.speed;
  redraw();
}

function setUnits(name) {
  scene.units = UNITS[name] ?? UNITS["m, m/s"];
  localStorage.setItem("units", name);
  redraw();
}

function setView(kind) {
  view.kind = kind;
  redraw();
}

function setCamera(mode) {
  cameraChosen = true;
  scene.show(mode);
  redraw();
}

function currentView() {
  if (view.kind === "zoom") return [view.from, view.to];
  if (view.kind === "whole") return [begin(), Math.max(end(), begin() + 1)];
  const to = clock.live ? clock.t : Math.min(clock.t + WINDOW / 4, Math.max(end(), clock.t));
  const from = Math.max(to - WINDOW, Math.min(begin(), clock.t));
  return [from, Math.max(to, from + 1)];
}

// ---- Charts

function arrange() { // one canvas for each chart, when what the log holds has changed
  const found = choice.chosen(flight, chartsOf(flight, ghost)), key = found.map(chart => `${chart.title} ${chart.unit}`).join("\n");
  charts = found.map((chart, k) => ({...chart, canvas: charts[k]?.canvas}));
  if (key === chartKey) return;
  chartKey = key;
  $("charts").replaceChildren(...charts.map(chart => {
    chart.canvas = document.createElement("canvas");
    chart.canvas.setAttribute("role", "img");
    chart.canvas.setAttribute("aria-label", chart.title);
    listen(chart.canvas);
    return chart.canvas;
  }));
}

let selection = null, pointer = null; // a pair of times; the time under the pointer
function listen(canvas) { // a click seeks, a drag zooms all charts, a double click zooms out, the wheel zooms about the pointer
  let start = null;
  const at = event => timeAt(canvas, event.clientX - canvas.getBoundingClientRect().left, currentView());
  canvas.addEventListener("pointerdown", event => { start = [event.clientX, at(event)]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", event => {
    const [from, to] = currentView(), t = at(event);
    pointer = t >= from && t <= to ? t : null;
    redraw();
    if (start && Math.abs(event.clientX - start[0]) > 4) { selection = [start[1], at(event)].sort((a, b) => a - b); redraw(); }
  });
  canvas.addEventListener("pointerup", event => {
    if (selection) zoom(...selection);
    else if (start) { clock.playing = false; seek(at(event)); }
    start = selection = null;
  });
  canvas.addEventListener("pointerleave", () => { pointer = null; redraw(); });
  canvas.addEventListener("pointercancel", () => { start = selection = null; });
  canvas.addEventListener("dblclick", () => setView(clock.live ? "window" : "whole"));
  canvas.addEventListener("wheel", event => {
    if (!event.ctrlKey) return; // the wheel alone scrolls the page
    event.preventDefault();
    const [from, to] = currentView(), centre = at(event), factor = Math.exp(event.deltaY * 0.002);
    zoom(centre - (centre - from) * factor, centre + (to - centre) * factor);
  }, {passive: false});
}

function zoom(from, to) {
  if (to - from < 1e-3) return;
  Object.assign(view, {kind: "zoom", from, to});
  redraw();
}

// ---- Drawing

function text(node, content) {
  if (node.textContent !== content) node.textContent = content;
}

function drawState() {
  const now = status(), badge = $("state"), {faults} = flight.head;
  text(badge, now);
  badge.className = `badge ${BADGES[now]}`;
  text($("name"), ghost ? `${flight.info.name} and ghost ${ghost.info.name}` : flight.info.name);
  document.title = `${now === "ENDED" ? "" : `${now}: `}${flight.info.name}`;
  drawMode();
  text($("time"), `t = ${clock.t.toFixed(2)} s${pointer === null ? "" : ` | ${pointer.toFixed(2)} s, ${(pointer - clock.t).toFixed(2)} s on`}`);
  const sentences = [link.refusal, ...faults, ...(ghost?.head.faults ?? []).map(one => `ghost: ${one}`)].filter(Boolean);
  $("notes").hidden = sentences.length === 0;
  if (list($("notes").lastElementChild, sentences)) text($("notes").firstElementChild, `${sentences.length} notes on the log`);
  for (const [id, on] of [["live", clock.live], ["window", view.kind === "window"], ["whole", view.kind === "whole"]]) $(id).setAttribute("aria-pressed", on);
  for (const button of $("cameras").querySelectorAll("[data-camera]")) button.setAttribute("aria-pressed", button.dataset.camera === scene.mode);
  text($("play"), clock.playing ? "Pause" : "Play");
  text($("legend"), scene.legend ?? "");
  drawReadouts();
  drawEvents();
  drawModels();
}

function drawMode() { // large; the header flashes when a failsafe begins
  const mode = flight.get("internals")?.at("mode", clock.t), name = Number.isFinite(mode) ? flight.info.modes[""]?.[mode] ?? `mode ${mode}` : "";
  const guidance = named("mode", flight.get("guidance")), failsafe = FAILSAFES.mode.includes(guidance);
  text($("mode"), failsafe ? `${name} ${guidance.replace("_", " ")}`.trim() : name);
  $("mode").style.background = MODE_COLOURS[mode] ?? "";
  $("mode").dataset.dark = [0, 2].includes(mode) ? "no" : "yes";
  document.body.classList.toggle("alarm", failsafe || FAILSAFES[""].includes(name));
}

function list(node, lines) {
  if (node.dataset.shown === lines.join("\n")) return false;
  node.dataset.shown = lines.join("\n");
  node.replaceChildren(...lines.map(line => Object.assign(document.createElement("li"), {textContent: line})));
  return true;
}

const airspeed = () => { // V0 and V of y, m/s; NaN where V0 is not known
  const V = flight.get("internals")?.at("y.V", clock.t) ?? NaN, y = Number.isFinite(V) ? V : flight.get("guidance")?.at("y.V", clock.t) ?? flight.get("y")?.at("V", clock.t) ?? NaN;
  return (flight.info.speed ?? NaN) + y;
};

const named = (channel, guidance) => flight.info.modes[channel]?.[guidance?.at(channel, clock.t)];

function minutes(seconds) { // as in 2:05
  return Number.isFinite(seconds) ? `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}` : "-";
}

function drawTapes(pose) { // airspeed and altitude over the commands of guidance, and the heading
  const {units} = scene, guidance = flight.get("guidance"), command = name => guidance?.at(name, clock.t) ?? NaN, degrees = 180 / Math.PI;
  const speed = airspeed(), holdsAltitude = ["ALTITUDE", "PROFILE"].includes(named("mode.vertical", guidance));
  const tape = ({unit, factor}, value, wanted, span) => ({unit, value: value * factor, command: wanted * factor, span: span * factor});
  const hasSpeed = Number.isFinite(flight.info.speed ?? NaN);
  $("airspeed").hidden = !hasSpeed;
  if (hasSpeed) drawTape($("airspeed"), {name: "V", right: true, ...tape(units.speed, speed, command("V_c"), SPANS.speed * flight.info.speed)}, colour);
  drawTape($("altitude"), {name: "altitude", right: false, ...tape(units.height, pose?.altitude ?? NaN, holdsAltitude ? command("target.altitude") : NaN, SPANS.height)}, colour);
  const heading = pose?.row >= 0 ? pose.psi * degrees : NaN, wanted = command(HEADINGS[named("mode.lateral", guidance)]) * degrees;
  drawHeading($("heading"), heading, wanted, colour);
}

function drawReadouts() {
  const pose = poseAt(flight, clock.t), degrees = 180 / Math.PI, guidance = flight.get("guidance"), {units} = scene;
  const heading = pose?.row >= 0 && Number.isFinite(pose.psi) ? `${String((Math.round(pose.psi * degrees) + 360) % 360).padStart(3, "0")} deg` : "-";
  const angle = value => shownAs({unit: "deg", factor: degrees}, value, 1);
  const values = {
    heading, roll: angle(pose?.phi), pitch: angle(pose?.theta), altitude: shownAs(units.height, pose?.altitude, 1),
    "ground speed": shownAs(units.speed, pose?.speed, 1), climb: shownAs(units.climb, pose?.climb, units.climb.factor > 10 ? 0 : 1),
  };
  if (guidance) {
    values.guidance = named("mode", guidance) ?? "-";
    values.holds = ["mode.lateral", "mode.vertical"].map(name => named(name, guidance) ?? "-").join(", ");
    const at = name => guidance.at(name, clock.t), leg = at("leg"), after = flight.info.to_end?.[leg];
    const onRoute = named("mode.lateral", guidance) === "ROUTE", last = leg + 1 >= (flight.info.to_end?.length ?? Infinity); // the last orbit has no end
    const toGo = distance => `${distanceText(units, distance)}, ${minutes(distance / Math.max(pose?.speed, 1))}`;
    values.leg = !Number.isFinite(leg) || !onRoute ? "-" : last || !Number.isFinite(at("to_go")) ? leg.toFixed(0) : `${leg}: ${toGo(at("to_go"))}`;
    values["cross-track"] = shownAs(units.near, at("xtrack"), 1);
    values["route to go"] = last || !onRoute || after === undefined ? "-" : toGo(at("to_go") + after);
  }
  const toNorth = guidance?.at("wind.north", clock.t), toEast = guidance?.at("wind.east", clock.t);
  if (Number.isFinite(toNorth) && Number.isFinite(toEast)) values.wind = windText(units, toNorth, toEast);
  const node = $("readouts"), names = Object.keys(values);
  if (node.children.length !== 2 * names.length) {
    node.replaceChildren(...names.flatMap(name => [Object.assign(document.createElement("dt"), {textContent: name}), document.createElement("dd")]));
  }
  Object.values(values).forEach((value, k) => text(node.children[2 * k + 1], value));
}

let shownModes = "";
function drawModes(modes) { // the legend of the timeline
  if (shownModes === `${modes}`) return;
  shownModes = `${modes}`;
  $("modes").replaceChildren(...modes.map(mode => {
    const item = document.createElement("span"), square = document.createElement("i");
    square.style.background = modeColour(mode);
    item.append(square, flight.info.modes[""]?.[mode] ?? `mode ${mode}`);
    return item;
  }));
}

function drawEvents() { // in the order of time; the last one before the cursor is marked
  const node = $("events");
  if (shownEvents !== flight.events.length) {
    shownEvents = flight.events.length;
    node.replaceChildren(...flight.events.map(({t, kind, text: content}) => {
      const item = Object.assign(document.createElement("li"), {className: kind, textContent: `${t.toFixed(2)} s  ${kind}: ${content}`});
      item.addEventListener("click", () => seek(t));
      return item;
    }));
    node.scrollTop = node.scrollHeight;
  }
  const past = flight.events.findLastIndex(({t}) => t <= clock.t + 1e-9);
  node.querySelector(".now")?.classList.remove("now");
  node.children[past]?.classList.add("now");
}

function drawModels() { // the rms of the error under the initial law and under each model of a learner
  const node = $("models"), {headings, rows = []} = flight.head.models, shown = JSON.stringify([headings, rows]);
  node.hidden = rows.length === 0;
  if (node.hidden || node.dataset.shown === shown) return;
  node.dataset.shown = shown;
  const cell = content => Object.assign(document.createElement("td"), {textContent: content});
  const lines = [headings, ...rows].map(cells => {
    const line = document.createElement("tr");
    line.append(...cells.map(cell));
    return line;
  });
  node.tBodies[0].replaceChildren(...lines);
}

let before = 0, second = 0;
function frame(now) {
  requestAnimationFrame(frame);
  const elapsed = Math.min(now - before, 250) / 1e3;
  before = now;
  if (clock.playing) {
    clock.t += elapsed * clock.speed;
    if (clock.t >= end()) { clock.t = end(); clock.playing = false; }
    dirty = true;
  }
  if (Math.floor(now / 250) !== second) { second = Math.floor(now / 250); drawState(); } // states change without samples, too
  if (dirty) {
    dirty = false;
    arrange();
    scene.draw(flight, others(), clock.t, colour);
    drawState();
    drawHorizon($("horizon"), poseAt(flight, clock.t), colour);
    drawTapes(poseAt(flight, clock.t));
    const shown = currentView();
    for (const chart of charts) {
      const {top, bottom} = chart.canvas.getBoundingClientRect();
      if (bottom > 0 && top < innerHeight) drawChart(chart.canvas, chart, flight, shown, clock.t, {selection, pointer}, colour);
    }
    drawAxis($("axis"), shown, clock.t, colour);
    drawModes(drawTimeline($("timeline"), flight, [begin(), Math.max(end(), begin() + 1)], shown, clock.t, colour));
    document.body.dataset.drawn = Number(document.body.dataset.drawn ?? 0) + 1;
  }
}

// ---- Controls

const ACTIONS = {
  " ": play, l: live, w: () => setView("window"), a: () => setView("whole"), "[": () => jump(-1), "]": () => jump(1),
  ArrowLeft: event => step(-1, event.shiftKey), ArrowRight: event => step(1, event.shiftKey),
  Home: () => seek(begin()), End: () => seek(end()), "-": () => setSpeed(SPEEDS.indexOf(clock.speed) - 1), "+": () => setSpeed(SPEEDS.indexOf(clock.speed) + 1),
  c: () => setCamera({chase: "orbit", orbit: "map", map: "chase"}[scene.mode]),
};

function start() {
  $("speed").append(...SPEEDS.map(speed => new Option(`${speed}x`, speed, false, speed === 1)));
  $("speed").addEventListener("change", () => setSpeed(SPEEDS.indexOf(Number($("speed").value))));
  for (const [id, action] of [["play", play], ["back", event => step(-1, event.shiftKey)], ["forth", event => step(1, event.shiftKey)],
    ["previous", () => jump(-1)], ["next", () => jump(1)], ["live", live], ["window", () => setView("window")], ["whole", () => setView("whole")]]) {
    $(id).addEventListener("click", action);
  }
  $("aircraft").addEventListener("change", () => choose(Number($("aircraft").value)));
  const kept = localStorage.getItem("units");
  $("units").append(...Object.keys(UNITS).map(name => new Option(name, name, false, name === kept)));
  $("units").addEventListener("change", () => setUnits($("units").value));
  if (kept in UNITS) setUnits(kept);
  $("cameras").addEventListener("click", ({target}) => { if (target.dataset.camera) setCamera(target.dataset.camera); });
  togglesFlyTo();
  choice.begin(redraw);
  addEventListener("keydown", event => {
    const action = ACTIONS[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, input, textarea") || (event.key === " " && event.target.closest("button"))) return;
    event.preventDefault();
    action(event);
  });
  const timeline = $("timeline"), to = event => timelineTime(timeline, event.clientX - timeline.getBoundingClientRect().left, [begin(), Math.max(end(), begin() + 1)]);
  timeline.addEventListener("pointerdown", event => { timeline.setPointerCapture(event.pointerId); clock.playing = false; seek(to(event)); });
  timeline.addEventListener("pointermove", event => { if (event.buttons) seek(to(event)); });
  for (const kind of ["resize", "scroll"]) addEventListener(kind, redraw, {passive: true});
  follow(flight);
  requestAnimationFrame(frame);
}

start();

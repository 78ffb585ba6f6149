// Control of the flight: a pending list of gains, targets, the bridge, faults. A button, or a click on the map, sends.
import {HEADERS} from "./data.js";

const RENEW = 1500; // ms; the lease lasts 5 s
const HOLD = 1000; // ms that the button of an engagement is held
const CHECK = 400; // ms after the last change of a slider
const ANGLES = ["phi", "theta", "heading", "course"]; // shown in degrees
const KINDS = ["stuck", "lost", "failed", "weak", "slow", "loose", "hard_over upper", "hard_over lower"]; // faults of an effector
const DEGREE = Math.PI / 180;

const $ = id => document.getElementById(id);
let lease = "", key = "", state = null, offered = false, margins = null, timer = 0, checking = 0;
const pending = new Map(); // by gain: its values

async function send(request) {
  const headers = {...HEADERS, "Content-Type": "application/json", "X-Control-Key": key, "X-Control-Lease": lease};
  try {
    const response = await fetch("control", {method: "POST", headers, body: JSON.stringify(request), signal: AbortSignal.timeout(60_000)});
    const text = await response.text();
    const found = text.startsWith("{") ? JSON.parse(text) : {refused: text.trim()};
    if (response.ok) return found;
    say(found.refused, true);
    if ([401, 403, 423].includes(response.status) && !state) stop();
  } catch (error) {
    say(`no answer: ${error.message}`, true);
  }
  return null;
}

async function act(request, done) {
  const found = await send(request);
  if (!found) return false;
  take(found);
  if (done) say(done, false);
  return true;
}

// What the desk is built from: nodes start and end, and the log has the axes of the wind from its first sample of truth on.
const desk = found => found && JSON.stringify([found.nodes, Boolean(found.gains), found.aircraft, found.bridge]);

function take(found) {
  const changed = desk(state) !== desk(found);
  lease = found.lease;
  state = found;
  $("control-key").hidden = true;
  for (const id of ["control", "control-desk"]) $(id).hidden = false;
  if (changed) build();
  showPilot();
  show();
}

function stop() {
  clearInterval(timer);
  state = null;
  $("control-key").hidden = false;
  for (const id of ["control-desk", "pilot", "fly-to"]) $(id).hidden = true;
}

const has = name => Boolean(state?.nodes.includes(name));

function showPilot() { // what a pilot needs at once, in the header
  $("pilot").hidden = !["guidance", "controller", "bridge"].some(has);
  $("pilot-hold").hidden = $("pilot-home").hidden = !has("guidance");
  $("pilot-stop").hidden = !has("controller") && !has("bridge");
  $("pilot-stop").textContent = has("bridge") ? "Disengage" : "Deactivate";
  $("fly-to").hidden = state.radius === undefined;
}

// A click on the map: the least orbit round a place, north and east in m; of a multicopter, whose radius is 0, the place.
export function flyTo([north, east]) {
  if (state?.radius === undefined || $("fly-to").ariaPressed !== "true") return;
  const place = {north: Math.round(north), east: Math.round(east)};
  act({do: "target", values: state.radius ? {...place, radius: state.radius} : place}, `flies to north ${place.north} m, east ${place.east} m`);
}

export function togglesFlyTo() {
  $("fly-to").addEventListener("click", () => { $("fly-to").ariaPressed = $("fly-to").ariaPressed !== "true"; });
}

function say(text, refused) {
  $("control-said").textContent = text;
  $("control-said").className = refused ? "error" : "";
}

function element(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

const button = (text, action, properties = {}) => {
  const node = element("button", {textContent: text, ...properties});
  node.addEventListener("click", action);
  return node;
};

// ---- What the nodes of the flight offer

function build() {
  const parts = [];
  if (state.gains) parts.push(gains());
  if (state.nodes.includes("controller") && !state.nodes.includes("bridge")) {
    parts.push(row("Controller", button("Activate", () => act({do: "activate"}, "activated"))));
  }
  if (state.nodes.includes("bridge")) parts.push(bridge());
  if (state.nodes.includes("guidance")) parts.push(guidance());
  if (state.aircraft) parts.push(faults());
  if (!parts.length) parts.push(element("p", {textContent: "No node of a flight runs in this domain."}));
  $("control-parts").replaceChildren(...parts);
}

const row = (label, ...nodes) => element("div", {className: "row"}, element("b", {textContent: label}), ...nodes);

function gains() {
  const body = element("tbody", {id: "control-gains"});
  for (const {name, values, ranges, channels} of state.gains) {
    values.forEach((_, k) => {
      const [low, high] = ranges[k], label = [name, channels[k]].filter(Boolean).join(" ");
      const slider = element("input", {type: "range", min: low, max: high, step: "any", disabled: low === high});
      slider.setAttribute("aria-label", label);
      slider.dataset.gain = name;
      slider.dataset.place = k;
      slider.addEventListener("input", () => change(name, k, Number(slider.value)));
      body.append(element("tr", {}, element("td", {textContent: label}), element("td", {}, slider), element("td"), element("td")));
    });
  }
  return element("details", {open: true}, element("summary", {textContent: "Gains"}),
    element("table", {}, element("thead", {}, element("tr", {}, ...["", "0.5 to 2 times the scenario", "in flight", "pending"].map(one => element("th", {textContent: one})))), body),
    element("p", {id: "control-margins"}),
    element("div", {className: "row"},
      button("Apply", apply, {id: "control-apply"}), button("Discard", discard, {id: "control-discard"}), button("Undo", undo, {id: "control-undo"}), element("span", {id: "control-logged"})));
}

function change(name, place, value) {
  const gain = state.gains.find(one => one.name === name);
  const values = [...(pending.get(name) ?? gain.values)];
  values[place] = Number(value.toPrecision(3));
  const [low, high] = gain.ranges[place];
  values[place] = Math.min(Math.max(values[place], low), high);
  if (values.every((one, k) => one === gain.values[k])) pending.delete(name); else pending.set(name, values);
  margins = null;
  clearTimeout(checking);
  checking = setTimeout(check, CHECK);
  show();
}

async function check() {
  margins = pending.size ? await send({do: "check", values: Object.fromEntries(pending)}) : null;
  show();
}

async function apply() {
  const values = Object.fromEntries(pending);
  if (await act({do: "gains", digest: state.digest, values}, "applied")) discard();
  else await act({do: "state"});
}

function discard() {
  pending.clear();
  margins = null;
  show();
}

async function undo() {
  if (!(await act({do: "undo", digest: state.digest}, "undone"))) await act({do: "state"});
}

function bridge() {
  const name = element("input", {placeholder: `name of the map: ${state.bridge.map}`, id: "control-map"}), hold = button(`Engage (hold ${HOLD / 1e3} s)`, () => {});
  let held = 0;
  hold.addEventListener("pointerdown", () => { held = setTimeout(() => act({do: "engage", map: name.value}, "engaged"), HOLD); });
  for (const kind of ["pointerup", "pointerleave", "pointercancel"]) hold.addEventListener(kind, () => clearTimeout(held));
  return row(`Bridge ${state.bridge.map}${state.bridge.sends ? "" : " (dry run)"}`, name, hold);
}

function guidance() {
  const choice = element("select", {}, ...state.targets.map(one => new Option(ANGLES.includes(one) ? `${one} (deg)` : one, one)));
  const value = element("input", {type: "number", step: "any", id: "control-target"});
  choice.setAttribute("aria-label", "Target");
  value.setAttribute("aria-label", "Value of the target");
  const list = new Map();
  const listed = element("span"), add = () => {
    if (value.value === "") return;
    list.set(choice.value, Number(value.value));
    listed.textContent = [...list].map(([name, one]) => `${name} ${one}`).join(", ");
  };
  const command = async () => {
    if (!list.size) add();
    const values = Object.fromEntries([...list].map(([name, one]) => [name, ANGLES.includes(name) ? one * DEGREE : one]));
    if (await act({do: "target", values}, "in force")) { list.clear(); listed.textContent = ""; }
  };
  const route = element("textarea", {rows: 3, placeholder: "north east altitude, in m, a line a waypoint"});
  route.setAttribute("aria-label", "Route");
  const fly = () => act({do: "route", points: route.value.trim().split(/\n+/).map(line => line.trim().split(/[\s,;]+/).map(Number))}, "sent; the events say if guidance refuses it");
  return element("details", {open: true}, element("summary", {textContent: "Guidance"}),
    element("div", {className: "row"}, choice, value, button("Add", add), listed, button("Command", command, {id: "control-command"})),
    element("div", {className: "row"}, button("Skip waypoint", () => act({do: "skip"}, "skips the waypoint ahead")),
      button("Resume route", () => act({do: "resume"}, "resumes the last leg"))),
    route, element("div", {className: "row"}, button("Fly this route", fly)));
}

const FAULTS = "actuators.faults"; // sentences "INPUT KIND AT", s: at 0 is now
const faultsNow = () => state.faults[FAULTS] ?? [];

function faults() {
  const {inputs, outputs, axes} = state.aircraft;
  const actuators = inputs.map(name => {
    const choice = element("select", {}, ...["", ...KINDS].map(kind => new Option(kind || "works", kind)));
    choice.setAttribute("aria-label", `Actuator ${name}`);
    choice.dataset.actuator = name;
    choice.addEventListener("change", () => {
      const [kind, end = ""] = choice.value.split(" ");
      const others = faultsNow().filter(fault => fault.split(" ")[0] !== name);
      const values = {[FAULTS]: kind ? [...others, `${name} ${kind} 0 ${end}`.trim()] : others};
      act({do: "fault", values}, `${name}: ${choice.selectedOptions[0].text}`);
    });
    return element("label", {}, `${name} `, choice);
  });
  const numbers = kind => outputs.map((name, k) => {
    const input = element("input", {type: "number", step: "any", value: state.faults[`sensors.${kind}`]?.[k] ?? 0});
    input.setAttribute("aria-label", `${kind} of ${name}`);
    return element("label", {}, `${name} `, input);
  });
  const sensor = (kind, title) => {
    const fields = numbers(kind), values = () => fields.map(field => Number(field.lastChild.value));
    return row(title, ...fields, button("Set", () => act({do: "fault", values: {[`sensors.${kind}`]: values()}}, `${kind} set`)));
  };
  const dropout = element("input", {type: "number", min: 0, max: 0.99, step: 0.05, value: state.faults["sensors.dropout"] ?? 0});
  dropout.setAttribute("aria-label", "Loss of samples");
  const parts = [
    row("Actuators", ...actuators), sensor("bias", "Bias (SI)"), sensor("noise", "Noise (SI)"),
    row("Loss of samples", dropout, button("Set", () => act({do: "fault", values: {"sensors.dropout": Number(dropout.value)}}, "loss set"))),
  ];
  if (axes.length) {
    const axis = element("select", {}, ...axes.map(one => new Option(one, one)));
    axis.setAttribute("aria-label", "Axis of the gust");
    const speed = element("input", {type: "number", value: 3}), length = element("input", {type: "number", value: 30});
    parts.push(row("Gust", axis, element("label", {}, "m/s ", speed), element("label", {}, "H in m ", length),
      button("Now", () => act({do: "gust", axis: axis.value, speed: Number(speed.value), length: Number(length.value)}, "gust begins"), {id: "control-gust"})));
  }
  return element("details", {open: true}, element("summary", {textContent: "Faults of the simulated aircraft"}), ...parts);
}

// ---- What changes

function show() {
  if (!state) return;
  for (const choice of document.querySelectorAll("[data-actuator]")) {
    const fault = faultsNow().findLast(text => text.split(" ")[0] === choice.dataset.actuator)?.split(" ") ?? [];
    choice.value = [fault[1], fault[1] === "hard_over" ? fault[3] : ""].filter(Boolean).join(" ");
  }
  const body = $("control-gains");
  if (!body) return;
  for (const line of body.children) {
    const slider = line.querySelector("input"), {gain, place} = slider.dataset;
    const now = state.gains.find(one => one.name === gain).values[place], next = pending.get(gain)?.[place];
    if (document.activeElement !== slider || next === undefined) slider.value = next ?? now;
    line.children[2].textContent = now.toPrecision(4);
    line.children[3].textContent = next === undefined || next === now ? "" : next.toPrecision(4);
  }
  $("control-apply").textContent = `Apply ${pending.size || ""}`;
  $("control-apply").disabled = $("control-discard").disabled = !pending.size;
  $("control-undo").disabled = !state.undo;
  $("control-logged").textContent = state.logged === state.digest ? "as in the log" : "not in the log yet";
  const shown = one => (one === null ? "over 500 ms" : `${(1e3 * one).toFixed(1)} ms`);
  $("control-margins").textContent = !pending.size ? "" : margins?.channels
    ? `pending: delay margin ${shown(margins.delay_margin)}, at least ${shown(margins.least)}; alone: ${Object.entries(margins.channels).map(([name, one]) => `${name} ${shown(one)}`).join(", ")}`
    : margins ? "no linear loop: no delay margin" : "delay margin ...";
  $("control-margins").className = margins?.channels && margins.delay_margin !== null && margins.delay_margin < margins.least ? "error" : "";
}

// Offer control where the server has it.
export function offer() {
  if (offered) return;
  offered = true;
  $("control-key").hidden = false;
  $("pilot-hold").addEventListener("click", () => act({do: "hold"}, "holds"));
  $("pilot-home").addEventListener("click", () => act({do: "home"}, "flies home"));
  $("pilot-stop").addEventListener("click", () => (has("bridge") ? act({do: "disengage"}, "disengaged") : act({do: "deactivate"}, "deactivated")));
  const begin = async () => {
    key = $("control-typed").value;
    if (!(await act({do: "state"}, ""))) return;
    say("", false);
    clearInterval(timer);
    timer = setInterval(async () => {
      const found = await send({do: "state"});
      if (found) take(found);
    }, RENEW);
  };
  $("control-take").addEventListener("click", begin);
  $("control-typed").addEventListener("keydown", event => { if (event.key === "Enter") begin(); });
}

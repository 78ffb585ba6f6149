// Draws the figures of a report: each <figure> holds a plotly specification; plotly and all samples are packed in the page.
"use strict";

const MARGIN = 0.5; // of the view, drawn on both sides of it for panning
const SHEET = {width: 690, height: 0.61, text: 0.72}; // pixels; scales of height and text, so that two figures fit a sheet of A4 or letter
const LETTER = 0.6; // of the size of a font, the width of a letter
const BETWEEN = 6; // pixels between two labels
const DEGREE = Math.PI / 180; // rad
const DARK = JSON.parse(document.getElementById("dark").textContent);
const scheme = matchMedia("(prefers-color-scheme: dark)");
const figures = [...document.querySelectorAll("figure")].map(node => ({
  node, text: node.querySelector("script").textContent, inTime: "time" in node.dataset, plot: node.querySelector("[data-plot]"), drawn: "",
}));
let range = null; // s, time range of all figures over time; null: the whole flight
let turn = 0;

// ---- Packed content: base64 of a zlib stream of shuffled bytes (plotting.pack)

async function unpack(id, width = 1) {
  const packed = await fetch("data:;base64," + document.getElementById(id).textContent);
  const stream = packed.body.pipeThrough(new DecompressionStream("deflate"));
  const shuffled = new Uint8Array(await new Response(stream).arrayBuffer());
  if (width === 1) return shuffled.buffer;
  const count = shuffled.length / width, lanes = width / 4, words = new Uint32Array(count * lanes);
  for (let lane = 0; lane < lanes; lane++) {
    const [a, b, c, d] = [0, 1, 2, 3].map(byte => shuffled.subarray((4 * lane + byte) * count));
    for (let k = 0; k < count; k++) words[k * lanes + lane] = a[k] | b[k] << 8 | c[k] << 16 | d[k] << 24;
  }
  return words.buffer;
}

async function unpackValues(id) { // steps of the bits of float32
  const bits = new Uint32Array(await unpack(id, 4));
  for (let k = 1; k < bits.length; k++) bits[k] += bits[k - 1];
  return new Float32Array(bits.buffer);
}

async function unpackTimes(id) { // steps in ns -> s
  const t = new Float64Array(await unpack(id, 8));
  let sum = 0;
  return t.map(step => (sum += step) / 1e9);
}

const kept = new Map();
const read = new Promise(resume => addEventListener("DOMContentLoaded", resume)); // the samples follow this script
async function samples(id) {
  await read;
  if (!kept.has(id)) kept.set(id, id[0] === "t" ? unpackTimes(id) : unpackValues(id));
  return kept.get(id);
}

// ---- Decimation of a view: all samples up to `most`, else minimum and maximum of each bin, and the gaps

function firstAfter(t, instant) {
  let low = 0, high = t.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (t[middle] < instant) low = middle + 1; else high = middle;
  }
  return low;
}

function view(t, v, [from, to], most) {
  const begin = Math.max(firstAfter(t, from) - 1, 0), end = Math.min(firstAfter(t, to) + 2, t.length);
  const width = end - begin > most ? Math.ceil((end - begin) / (most / 2)) : 1;
  const indices = [];
  for (let first = begin; first < end; first += width) {
    let low = -1, high = -1, gap = -1;
    for (let k = first; k < Math.min(first + width, end); k++) {
      if (Number.isNaN(v[k])) gap = k;
      else {
        if (low < 0 || v[k] < v[low]) low = k;
        if (high < 0 || v[k] > v[high]) high = k;
      }
    }
    indices.push(...[...new Set([low, high, gap])].filter(k => k >= 0).sort((a, b) => a - b));
  }
  return {x: indices.map(k => t[k]), y: indices.map(k => v[k])};
}

async function views(data) { // of the traces that the page decimates, by index
  const [from, to] = range ?? [-Infinity, Infinity], margin = range ? MARGIN * (to - from) : 0;
  const wide = [from - margin, to + margin];
  const long = [...data.entries()].filter(([, {meta}]) => meta?.t);
  return new Map(await Promise.all(long.map(async ([index, {meta}]) => {
    const {x, y} = view(await samples(meta.t), await samples(meta.v), wide, meta.most);
    return [index, {x, y: meta.scale ? y.map(value => value * meta.scale) : y}];
  })));
}

// ---- Angles in rad

const numbers = y => (y.bdata ? [...new {f8: Float64Array, f4: Float32Array}[y.dtype](Uint8Array.from(atob(y.bdata), one => one.charCodeAt(0)).buffer)] : y);

function inRadians({data, layout}) { // a specification with its axes in deg converted
  const axisOf = name => (/^y\d*$/.test(name) ? name.replace("y", "yaxis") : ""), rad = text => text?.replace(/\bdeg\b/, "rad");
  const converted = Object.keys(layout).filter(key => /^yaxis\d*$/.test(key) && /\bdeg\b/.test(layout[key].title.text));
  const scaled = value => (value === null ? null : value * DEGREE);
  for (const key of converted) {
    layout[key].title.text = rad(layout[key].title.text);
    if (layout[key].range) layout[key].range = layout[key].range.map(scaled);
  }
  for (const trace of data.filter(({yaxis}) => converted.includes(axisOf(yaxis)))) {
    trace.hovertemplate = rad(trace.hovertemplate);
    if (trace.meta) trace.meta.scale = DEGREE;
    if (trace.y) trace.y = numbers(trace.y).map(scaled);
  }
  for (const shape of layout.shapes) if (converted.includes(axisOf(shape.yref))) [shape.y0, shape.y1] = [shape.y0, shape.y1].map(scaled);
  return {data, layout};
}

// ---- Labels of intervals

function labelled(figure, {margin}, [from, to], width) { // the annotations; labels that would overlap are joined
  const wide = width - margin.l - margin.r, joined = [], all = figure.annotations;
  const fitted = (texts, left, size) => {
    const whole = texts.join(", "), text = LETTER * size * whole.length > wide ? `${texts[0]} and ${texts.length - 1} more` : whole;
    const long = LETTER * size * text.length;
    return {texts, text, long, left: Math.max(Math.min(left, wide - long), 0)};
  };
  for (const label of all.filter(one => one.name === "interval" && one.x >= from && one.x < to)) {
    let one = fitted([label.text], (label.x - from) / (to - from) * wide, label.font.size);
    while (joined.length && joined.at(-1).left + joined.at(-1).long + BETWEEN > one.left) {
      const before = joined.pop();
      one = fitted([...before.texts, ...one.texts], before.left, label.font.size);
    }
    joined.push({...one, label});
  }
  const placed = joined.map(({label, text, left}) => ({...label, text, x: from + left / wide * (to - from)}));
  return [...all.filter(one => one.name !== "interval"), ...placed];
}

// ---- Drawing

const angles = () => document.getElementById("angles")?.value ?? "deg";
const look = () => `${scheme.matches ? "dark" : "light"} ${angles()}`;

const axes = layout => Object.keys(layout).filter(key => /^xaxis\d*$/.test(key));

function specification(figure, style) {
  const stored = JSON.parse(style === "dark" ? figure.text.replace(/#[0-9a-f]{6}/g, colour => DARK[colour] ?? colour) : figure.text);
  return angles() === "rad" && stored.layout.meta?.angles ? inRadians(stored) : stored;
}

async function draw(figure, style) {
  const {data, layout} = specification(figure, style.split(" ")[0]);
  for (const [index, {x, y}] of await views(data)) Object.assign(data[index], {x, y});
  if (range && figure.inTime) for (const axis of axes(layout)) layout[axis].range = [...range];
  figure.annotations = layout.annotations ?? [];
  if (figure.inTime) layout.annotations = labelled(figure, layout, layout.xaxis.range, figure.plot.clientWidth);
  layout.dragmode = document.getElementById("drag")?.value ?? "zoom";
  await Plotly.newPlot(figure.plot, data, layout, {displayModeBar: false, responsive: true, doubleClick: "reset"});
  if (figure.inTime) figure.plot.on("plotly_relayout", change => moved(figure, change));
}

async function follow(figure) { // show the time range of the other figures
  const decimated = await views(figure.plot.data), all = [...decimated.values()];
  const traces = {x: all.map(one => one.x), y: all.map(one => one.y)};
  const ranges = Object.fromEntries(axes(figure.plot.layout).map(axis => [`${axis}.range`, [...range]]));
  ranges.annotations = labelled(figure, figure.plot.layout, range, figure.plot.clientWidth);
  await Plotly.update(figure.plot, traces, ranges, [...decimated.keys()]);
}

function moved(figure, change) { // zoom all figures over time together
  if (!Object.keys(change).some(key => /^xaxis\d*\.(range|autorange)/.test(key))) return;
  range = [...figure.plot.layout.xaxis.range].map(Number);
  showAll();
}

async function showAll() { // the figure nearest to the view first, which may be scrolled meanwhile
  const mine = ++turn, wanted = figure => `${look()} ${figure.inTime && range}`, distance = ({node}) => {
    const {top, bottom} = node.getBoundingClientRect();
    return Math.max(top - innerHeight, -bottom, 0);
  };
  const next = () => figures.filter(one => one.drawn !== wanted(one)).sort((a, b) => distance(a) - distance(b))[0];
  for (let figure = next(); figure; figure = next()) {
    const style = look(), drawn = wanted(figure);
    if (figure.drawn.startsWith(style) && range && figure.inTime) await follow(figure);
    else await draw(figure, style);
    figure.drawn = drawn;
    performance.mark("figure");
    await new Promise(resume => setTimeout(resume)); // keep the page responsive
    if (mine !== turn) return; // superseded by a later call
  }
  document.body.dataset.drawn = turn;
}

function resized() { // the labels of intervals by the new width; plotly moves all else
  for (const figure of figures.filter(one => one.inTime && one.annotations?.length)) {
    const {plot} = figure, {layout} = plot;
    Plotly.relayout(plot, {annotations: labelled(figure, layout, layout.xaxis.range, plot.clientWidth)});
  }
}

function print() { // light colours, width of a sheet; synchronous, for the browser does not wait
  for (const figure of figures) {
    const {data, layout} = specification(figure, "light"), current = figure.plot.data ?? data;
    for (const [index, {x, y}] of current.entries()) Object.assign(data[index], {x, y});
    if (range && figure.inTime) for (const axis of axes(layout)) layout[axis].range = [...range];
    if (figure.inTime) layout.annotations = labelled(figure, layout, layout.xaxis.range, SHEET.width);
    for (const {font} of [layout, ...(layout.annotations ?? [])]) if (font) font.size *= SHEET.text; // an arrow has none
    Object.assign(layout, {width: SHEET.width, height: SHEET.height * layout.height});
    figure.plot.style.height = "auto";
    Plotly.newPlot(figure.plot, data, layout, {staticPlot: true});
    figure.drawn = "";
  }
}

function whole() { // show the whole flight in all figures over time again
  const figure = figures.find(one => one.inTime && one.plot.layout);
  const {layout} = specification(figure, "light");
  Plotly.relayout(figure.plot, {"xaxis.range": layout.xaxis.range});
}

function drag() { // what a drag of the mouse does, in every figure
  for (const {plot} of figures) if (plot.layout) Plotly.relayout(plot, {dragmode: document.getElementById("drag").value});
}

// ---- Tables and words

function folded() { // unfold for print, and where a link leads
  for (const details of document.querySelectorAll("details")) details.open = true;
}

function reached() { // open the block that holds the place of the address
  const place = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const details = place?.closest("details");
  if (details && !details.open) { details.open = true; place.scrollIntoView(); }
}

function scrollable() { // only what scrolls can be reached by keyboard
  for (const box of document.querySelectorAll(".scrolled, .contents")) {
    if (box.scrollWidth > box.clientWidth + 1) box.tabIndex = 0; else box.removeAttribute("tabindex");
  }
}

function explain() { // the meaning of a word beside it: by mouse, keyboard and touch
  const tip = document.getElementById("tip");
  const hide = () => { tip.hidden = true; };
  const show = word => {
    tip.textContent = document.querySelector(`${word.getAttribute("href")} dd`).textContent;
    tip.hidden = false;
    const {left, top, bottom} = word.getBoundingClientRect(), {offsetWidth, offsetHeight} = tip;
    tip.style.left = `${Math.max(Math.min(left, innerWidth - offsetWidth - 16), 16)}px`;
    tip.style.top = `${top > offsetHeight + 8 ? top - offsetHeight - 6 : bottom + 6}px`;
  };
  for (const word of document.querySelectorAll(".word")) {
    word.setAttribute("aria-describedby", "tip");
    for (const on of ["mouseenter", "focus"]) word.addEventListener(on, () => show(word));
    for (const off of ["mouseleave", "blur"]) word.addEventListener(off, hide);
    word.addEventListener("click", event => { event.preventDefault(); show(word); });
  }
  addEventListener("keydown", event => { if (event.key === "Escape") hide(); });
  addEventListener("scroll", hide, {passive: true});
}

async function run(id) { // a packed script
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpack(id));
  document.head.append(script);
}

async function start() {
  await read;
  explain();
  scrollable();
  reached();
  addEventListener("hashchange", reached);
  addEventListener("resize", scrollable, {passive: true});
  document.addEventListener("toggle", scrollable, true);
  addEventListener("beforeprint", folded);
  if (!figures.length) return;
  await run("library");
  await showAll();
  if (document.getElementById("replay-code")) await run("replay-code");
  scheme.addEventListener("change", showAll);
  document.getElementById("angles")?.addEventListener("change", () => { document.body.dataset.in = angles(); showAll(); scrollable(); });
  document.getElementById("whole")?.addEventListener("click", whole);
  document.getElementById("drag")?.addEventListener("change", drag);
  addEventListener("resize", resized, {passive: true});
  addEventListener("beforeprint", print);
  addEventListener("afterprint", showAll);
}

start().catch(error => {
  const message = document.createElement("p");
  message.className = "notes";
  message.textContent = `The figures cannot be drawn: ${error}. They need a browser of 2023 or newer.`;
  document.querySelector("h1").after(message);
  throw error;
});

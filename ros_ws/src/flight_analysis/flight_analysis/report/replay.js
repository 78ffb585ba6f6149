// The replay of a report: scene and horizon of a flight, from the samples that the page holds.

const SPEEDS = [0.1, 0.5, 1, 2, 5, 10];

async function seriesOf({t, channels}) { // each channel: where its values are, and the factor that they have there
  const one = new Series(Object.keys(channels));
  one.t = await samples(t);
  one.columns = await Promise.all(Object.values(channels).map(async ([id, factor]) => (await samples(id)).map(value => value / factor)));
  one.count = one.t.length;
  one.gap = one.count > 1 ? 3 * (one.t[one.count - 1] - one.t[0]) / (one.count - 1) : 0;
  return one;
}

async function replay() {
  const {topics, info} = JSON.parse(document.getElementById("replay-data").textContent), found = new Map();
  for (const [name, one] of Object.entries(topics)) found.set(name, await seriesOf(one));
  const flight = {get: name => found.get(name), info}, ends = [...found.values()].map(({t}) => [t[0], t[t.length - 1]]);
  const begin = Math.min(...ends.map(one => one[0])), end = Math.max(...ends.map(one => one[1]));
  const [canvas, horizon, play, speed, slider, time] = ["scene", "horizon", "play", "speed", "time", "now"].map(name => document.getElementById(`replay-${name}`));
  const cameras = [...document.querySelectorAll("#replay [data-camera]")];
  let t = begin, playing = false, before = 0, waiting = false, colours = {};
  const colour = name => (colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  const ask = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const scene = new Scene(canvas, ask);

  function draw(now) {
    waiting = false;
    if (playing) t += Math.min(now - before, 250) / 1e3 * Number(speed.value);
    before = now;
    if (t >= end) { t = end; playing = false; }
    scene.draw(flight, [], t, colour);
    drawHorizon(horizon, poseAt(flight, t), colour);
    slider.value = t;
    const mode = flight.get("internals")?.at("mode", t);
    time.textContent = `t = ${t.toFixed(2)} s  ${info.modes[mode] ?? ""}`;
    play.textContent = playing ? "Pause" : "Play";
    for (const one of cameras) one.setAttribute("aria-pressed", one.dataset.camera === scene.mode);
    document.getElementById("replay-legend").textContent = scene.legend ?? "";
    document.getElementById("replay").dataset.drawn = t;
    if (playing) ask();
  }

  speed.append(...SPEEDS.map(one => new Option(`${one}x`, one, false, one === 1)));
  Object.assign(slider, {min: begin, max: end, step: "any"});
  slider.addEventListener("input", () => { playing = false; t = Number(slider.value); ask(); });
  play.addEventListener("click", () => { playing = !playing; if (playing && t >= end) t = begin; before = performance.now(); ask(); });
  for (const one of cameras) one.addEventListener("click", () => { scene.show(one.dataset.camera); ask(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colours = {}; ask(); });
  addEventListener("resize", ask, {passive: true});
  ask();
}

replay();

/** What is shown, and what happens. */

import { STEPS, fromFragment, stepAt, toFragment, toTable } from "./values.js";
import { digitsOf, ownColour, setTheme, shown } from "./looks.js";
import { curvesPlot } from "./curves.js";
import { phasePlot } from "./phase.js";
import { sharesBars } from "./shares.js";
import { parameterControl } from "./controls.js";

const SECONDS = 8; // to play from start to end
const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const { unknowns, parameters, times } = data;
const ranges = new Map([...parameters, data.time].map(({ name, range }) => [name, range]));
const timeDigits = digitsOf(data.time.range);
const systemDark = matchMedia("(prefers-color-scheme: dark)");

/** Everything that changes. */
const state = {
  p: new Float64Array(parameters.length),
  time: 0,
  curves: [],
  values: new Float64Array(unknowns.length),
  visible: unknowns.map((_, i) => i < 8),
  together: true,
  phase: [0, Math.min(1, unknowns.length - 1)],
  sharesOf: 0,
  playing: false,
  frame: 0, // the next one of playing
};
const flat = new Float64Array(unknowns.length * times.length);
let plots = [];
let waiting = null;
const latencies = [];

// ---- What is drawn ----------------------------------------------------------------------------

/** Draw once before the next picture: everything, or what depends on time alone. */
function schedule(kind) {
  const since = performance.now();
  if (waiting) {
    if (kind === "all") waiting.kind = kind;
    return;
  }
  waiting = { kind, since };
  requestAnimationFrame(drawWaiting);
}

/** Draw what waits to be drawn, now. */
function drawWaiting() {
  if (!waiting) return;
  const asked = waiting;
  waiting = null;
  draw(asked.kind);
  queueMicrotask(() => latencies.push(performance.now() - asked.since));
}

function draw(kind) {
  if (kind === "all") {
    model.curve(state.p, times, flat);
    const count = times.length;
    state.curves = unknowns.map((_, i) => flat.subarray(i * count, (i + 1) * count));
  }
  model.evaluate(state.time, state.p, state.values);
  for (const part of [...plots, phase, shares]) {
    if (kind === "all" || part === shares) part?.update();
    else part?.mark();
  }
  showTime();
}

function showTime() {
  const unit = data.time.unit && ` ${data.time.unit}`;
  const text = `${shown(state.time, timeDigits)}${unit}`;
  $("time").value = String(stepAt(data.time.range, state.time));
  $("time").setAttribute("aria-valuetext", text);
  $("time-shown").textContent = text;
  if (shares) $("shares-time").textContent = `${data.time.text} = ${text}`;
  legend.forEach((entry, i) => {
    entry.querySelector(".value").textContent = shown(state.values[i]);
  });
}

/** Plots of the unknowns that are visible: one, or one each. */
function arrange() {
  plots.forEach((plot) => plot.remove());
  const place = $("plots");
  place.replaceChildren();
  place.classList.toggle("apart", !state.together);
  $("curves").classList.toggle("together", state.together);
  for (const button of $("arrangement").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", String(button.dataset.together === String(state.together)));
  }
  const rows = unknowns.map((_, i) => i).filter((i) => state.visible[i]);
  const groups = state.together ? [rows] : rows.map((i) => [i]);
  const narrow = innerWidth <= 900;
  const height = state.together ? (narrow ? 230 : 380) : groups.length > 2 || narrow ? 190 : 260;
  plots = groups
    .filter((group) => group.length)
    .map((group) => {
      const figure = document.createElement("div");
      figure.className = "plot";
      const named = group.map((i) => unknowns[i].text).join(", ");
      if (!state.together) figure.innerHTML = `<h3>${symbolWithUnit(unknowns[group[0]])}</h3>`;
      figure.setAttribute("role", "img");
      figure.setAttribute("aria-label", `Curves of ${named} over ${data.time.text}`);
      place.append(figure);
      return curvesPlot(figure, data, group, state, height, setTime);
    });
}

// ---- What happens -----------------------------------------------------------------------------

function setTime(time) {
  state.time = time;
  schedule("time");
}

function setParameter(j, value) {
  state.p[j] = value;
  schedule("all");
}

/** The values at which the page opens: the median of every parameter, the beginning of time. */
function start() {
  parameters.forEach(({ median }, j) => (state.p[j] = median));
  state.time = data.time.range[0];
}

function reset() {
  start();
  $("notice").hidden = true;
  showAll();
}

/** Set some parameters, or time, by name. What cannot be shown is an error, and changes nothing. */
function set(values) {
  const p = state.p.slice();
  let time = state.time;
  for (const [name, value] of Object.entries(values)) {
    if (typeof value !== "number") throw new TypeError(`${name} is ${String(value)}, not a number`);
    const j = parameters.findIndex((parameter) => parameter.name === name);
    if (j >= 0) p[j] = value;
    else if (name === data.time.name) time = value;
    else throw new RangeError(`there is no ${name}`);
  }
  model.evaluate(time, p);
  state.p.set(p);
  state.time = time;
  showAll();
}

function showAll() {
  controls.forEach((control, j) => control.show(state.p[j]));
  schedule("all");
}

function readLink() {
  if (!location.hash.includes("=")) return;
  const { values, problems } = fromFragment(location.hash, ranges);
  set(values);
  $("notice").hidden = true;
  if (problems.length) say(`The link could not be followed altogether: ${problems.join("; ")}.`);
}

function present() {
  const values = Object.fromEntries(parameters.map(({ name }, j) => [name, state.p[j]]));
  return { ...values, [data.time.name]: state.time };
}

async function copyLink() {
  history.replaceState(null, "", `#${toFragment(present())}`);
  try {
    await navigator.clipboard.writeText(location.href);
    say("The link with the present values is copied.");
  } catch {
    say("The address of this page is now the link with the present values: copy it from there.");
  }
}

function table() {
  drawWaiting();
  const rows = unknowns.map((_, i) => i).filter((i) => state.visible[i]);
  const heads = [data.time.name, ...rows.map((i) => unknowns[i].name), ...parameters.map((p) => p.name)];
  const fixed = parameters.map((_, j) => Array(times.length).fill(state.p[j]));
  return toTable(heads, [times, ...rows.map((i) => state.curves[i]), ...fixed]);
}

function saveTable() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([table()], { type: "text/csv" }));
  link.download = `${document.title.replace(/[^\p{L}\p{N}]+/gu, "_")}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function say(text) {
  $("notice").hidden = false;
  $("notice").textContent = text;
}

function play() {
  cancelAnimationFrame(state.frame);
  const [start, end] = data.time.range;
  state.playing = !state.playing;
  $("play").classList.toggle("playing", state.playing);
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (!state.playing) return;
  if (state.time >= end) state.time = start;
  let before = performance.now();
  const step = (now) => {
    if (!state.playing) return;
    setTime(Math.min(end, state.time + (Math.max(0, now - before) / 1000 / SECONDS) * (end - start)));
    before = now;
    if (state.time >= end) play();
    else state.frame = requestAnimationFrame(step);
  };
  state.frame = requestAnimationFrame(step);
}

function recolour(theme) {
  setTheme(theme);
  $("theme").setAttribute("aria-pressed", String(theme === "dark"));
  plots.forEach((plot) => plot.redraw());
  phase?.redraw();
}

// ---- The page ---------------------------------------------------------------------------------

function symbolWithUnit({ symbol, unit }) {
  const holder = document.createElement("span");
  holder.innerHTML = `${symbol} <span class="unit"></span>`;
  holder.querySelector(".unit").textContent = unit && `[${unit}]`;
  return holder.innerHTML;
}

function legendEntry(unknown, i) {
  const item = document.createElement("li");
  item.innerHTML = `<button type="button"><span class="line" style="--own: var(--c${i % 8})"></span>
    ${unknown.symbol}<span class="value"></span><span class="unit"></span></button>`;
  const button = item.firstElementChild;
  item.querySelector(".unit").textContent = unknown.unit;
  button.title = "Show or hide";
  button.setAttribute("aria-pressed", String(state.visible[i]));
  button.addEventListener("click", () => {
    state.visible[i] = !state.visible[i];
    button.setAttribute("aria-pressed", String(state.visible[i]));
    arrange();
  });
  $("legend").append(item);
  return item;
}

function choice(id, chosen, onChoice) {
  const list = $(id);
  unknowns.forEach(({ text }, i) => list.append(new Option(text, String(i))));
  list.value = String(chosen);
  list.addEventListener("change", () => {
    onChoice(Number(list.value));
    schedule("all");
  });
}

setTheme(systemDark.matches ? "dark" : "light");
if (unknowns.some(({ derivative }) => !derivative)) {
  unknowns.forEach(({ derivative }, i) => (state.visible[i] &&= !derivative));
}
const seen = unknowns.filter((_, i) => state.visible[i]);
const most = innerWidth <= 900 ? 8 : 3; // a narrow page keeps one plot in sight
state.together = seen.length <= most && new Set(seen.map(({ unit }) => unit)).size < 2;
$("arrangement").hidden = unknowns.length < 2;
$("time-label").innerHTML = data.time.symbol;
const legend = unknowns.map(legendEntry);
const controls = parameters.map((parameter, j) =>
  parameterControl($("parameters"), parameter, j, (value) => setParameter(j, value)),
);
if (!parameters.length) $("controls-title").textContent = "This solution";
start();
model.curve(state.p, times, flat);
state.curves = unknowns.map((_, i) => flat.subarray(i * times.length, (i + 1) * times.length));
model.evaluate(state.time, state.p, state.values);
arrange();
const phase = $("phase") && phasePlot($("phase-plot"), data, state);
const shares = $("shares") && sharesBars($("bars"), data, state);
if (phase) {
  choice("phase-x", state.phase[0], (i) => (state.phase[0] = i));
  choice("phase-y", state.phase[1], (i) => (state.phase[1] = i));
}
if (shares) choice("shares-of", 0, (i) => (state.sharesOf = i));

$("time").addEventListener("input", () => {
  const [start, end] = data.time.range;
  setTime(start + ((end - start) * Number($("time").value)) / STEPS);
});
$("play").addEventListener("click", play);
$("reset").addEventListener("click", reset);
$("link").addEventListener("click", copyLink);
$("csv").addEventListener("click", saveTable);
$("theme").addEventListener("click", () => {
  recolour(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
});
systemDark.addEventListener("change", () => recolour(systemDark.matches ? "dark" : "light"));
$("arrangement").addEventListener("click", ({ target }) => {
  if (!target.dataset.together) return;
  state.together = target.dataset.together === "true";
  arrange();
});
addEventListener("hashchange", readLink);
for (const link of document.querySelectorAll('a[href="#quality"]')) {
  link.addEventListener("click", () => ($("quality").open = true));
}
showAll();
readLink();

/**
 * For scripts: what the page shows.
 *
 * `values()` is what is drawn: `time`, `parameters` by name, `values` of the unknowns at that time,
 * `times` and `curves` by unknown, `shares` (first, total) by parameter. `set({name: value})` sets
 * parameters and time, or throws and changes nothing. `latencies` are milliseconds from what somebody did to the end of the drawing.
 */
window.rankone = {
  values: () => (drawWaiting(), {
    time: state.time,
    parameters: Object.fromEntries(parameters.map(({ name }, j) => [name, state.p[j]])),
    values: Object.fromEntries(unknowns.map(({ name }, i) => [name, state.values[i]])),
    times: [...times],
    curves: Object.fromEntries(unknowns.map(({ name }, i) => [name, [...state.curves[i]]])),
    shares: shares ? Object.fromEntries(shares.values().map((s, j) => [parameters[j].name, s])) : null,
  }),
  set,
  table,
  latencies,
};

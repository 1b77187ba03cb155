/** What is drawn, and when. */

import { stepAt } from "./values.js";
import { digitsOf, setTheme, shown } from "./looks.js";
import { curvesPlot } from "./curves.js";
import { symbolWithUnit } from "./legend.js";
import { $, data, evaluateModel, state, visibleRows } from "./state.js";

/** The parts of the page that show values; some pages have no phase plot or no shares. */
export const views = { plots: [], phase: null, shares: null, events: null, legend: [], controls: [] };

/** Milliseconds from what somebody did to the end of the drawing. */
export const latencies = [];

export const timeDigits = digitsOf(data.time.range);
let waiting = null;

/** Draw once before the next picture: everything, or what depends on time alone. */
export function schedule(kind) {
  const since = performance.now();
  if (waiting) {
    if (kind === "all") waiting.kind = kind;
    return;
  }
  waiting = { kind, since };
  requestAnimationFrame(drawWaiting);
}

/** Draw what waits to be drawn, now. */
export function drawWaiting() {
  if (!waiting) return;
  const asked = waiting;
  waiting = null;
  draw(asked.kind);
  queueMicrotask(() => latencies.push(performance.now() - asked.since));
}

function draw(kind) {
  const { plots, phase, shares } = views;
  evaluateModel(kind === "all");
  for (const part of [...plots, phase, shares]) {
    if (kind === "all" || part === shares) part?.update();
    else part?.mark();
  }
  if (kind === "all") views.events?.show(state.happenings, state.timed);
  showTime();
}

function showTime() {
  const unit = data.time.unit && ` ${data.time.unit}`;
  const text = `${shown(state.time, timeDigits)}${unit}`;
  $("time").value = String(stepAt(data.time.range, state.time));
  $("time").setAttribute("aria-valuetext", text);
  $("time-shown").textContent = text;
  if (views.shares) $("shares-time").textContent = `${data.time.text} = ${text}`;
  views.legend.forEach((entry, i) => entry.show(state.values[i]));
}

export function setTime(time) {
  state.time = time;
  schedule("time");
}

/** The sliders at the present values, and everything drawn. */
export function showAll() {
  views.controls.forEach((control, j) => control.show(state.p[j]));
  schedule("all");
}

/** Plots of the unknowns that are visible: one, or one each. */
export function arrange() {
  views.plots.forEach((plot) => plot.remove());
  const place = $("plots");
  place.replaceChildren();
  place.classList.toggle("apart", !state.together);
  $("curves").classList.toggle("together", state.together);
  for (const button of $("arrangement").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", String(button.dataset.together === String(state.together)));
  }
  const rows = visibleRows();
  const groups = state.together ? [rows] : rows.map((i) => [i]);
  const narrow = innerWidth <= 900;
  const low = Math.max(150, Math.min(230, 0.24 * innerHeight)) - (state.together ? 0 : 18); // sliders go below
  const height = narrow ? low : state.together ? 380 : groups.length > 2 ? 190 : 260;
  views.plots = groups.filter((group) => group.length).map((group) => plotOf(place, group, height));
}

function plotOf(place, group, height) {
  const { unknowns, time } = data;
  const figure = document.createElement("div");
  figure.className = "plot";
  if (!state.together) figure.innerHTML = `<h3>${symbolWithUnit(unknowns[group[0]])}</h3>`;
  figure.setAttribute("role", "img");
  figure.setAttribute(
    "aria-label",
    `Curves of ${group.map((i) => unknowns[i].text).join(", ")} over ${time.text}`,
  );
  place.append(figure);
  return curvesPlot(figure, data, group, state, height, setTime);
}

export function recolour(theme) {
  setTheme(theme);
  $("theme").setAttribute("aria-pressed", String(theme === "dark"));
  views.plots.forEach((plot) => plot.redraw());
  views.phase?.redraw();
}

/** When a page is drawn: once before the next picture, whatever has changed until then. */

import { stepAt } from "./values.js";
import { digitsOf, setTheme, shown } from "./looks.js";
import { $, data, state } from "./state.js";

/**
 * What a page draws: `draw(all)` everything, or what depends on time alone; `redraw()` what has
 * colours of its own, in new ones. `controls` are those of the parameters.
 */
export const page = { draw: () => {}, redraw: () => {}, controls: [] };

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
  page.draw(asked.kind === "all");
  showTime();
  queueMicrotask(() => latencies.push(performance.now() - asked.since));
}

/** The present time with its unit. */
export const timeText = () => `${shown(state.time, timeDigits)}${data.time.unit && ` ${data.time.unit}`}`;

function showTime() {
  const text = timeText();
  $("time").value = String(stepAt(data.time.range, state.time));
  $("time").setAttribute("aria-valuetext", text);
  $("time-shown").textContent = text;
}

export function setTime(time) {
  state.time = time;
  schedule("time");
}

/** The sliders at the present values, and everything drawn. */
export function showAll() {
  page.controls.forEach((control, j) => control.show(state.p[j]));
  schedule("all");
}

export function recolour(theme) {
  setTheme(theme);
  $("theme").setAttribute("aria-pressed", String(theme === "dark"));
  page.redraw();
}

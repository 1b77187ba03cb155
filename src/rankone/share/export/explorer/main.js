/** The page is set up. */

import { STEPS, areAlike } from "./values.js";
import { chosenTheme, keepTheme } from "./looks.js";
import { phasePlot } from "./phase.js";
import { sharesBars } from "./shares.js";
import { parameterControl } from "./controls.js";
import { legendEntry } from "./legend.js";
import { eventList } from "./events.js";
import { $, data, evaluateModel, start, state } from "./state.js";
import { arrange, drawWaiting, latencies, recolour, schedule, setTime, showAll, timeDigits, views } from "./drawing.js";
import {
  copyLink, fit, fitAndSay, load, loadFile, play, presentParameters, readLink, reset, saveTable, set, table,
} from "./actions.js";

const { unknowns, parameters } = data;
const systemDark = matchMedia("(prefers-color-scheme: dark)");
const systemTheme = () => (systemDark.matches ? "dark" : "light");

// ---- What is shown at first ---------------------------------------------------------------------

recolour(chosenTheme() ?? systemTheme());
if (unknowns.some(({ derivative }) => !derivative)) {
  unknowns.forEach(({ derivative }, i) => (state.visible[i] &&= !derivative));
}
const seen = unknowns.filter((_, i) => state.visible[i]);
const most = innerWidth <= 900 ? 8 : 3; // a narrow page keeps one plot in sight
state.together =
  seen.length <= most &&
  new Set(seen.map(({ unit }) => unit)).size < 2 &&
  areAlike(seen.map(({ extent }) => extent));
start();
evaluateModel(true);

// ---- Parts --------------------------------------------------------------------------------------

function choice(id, chosen, onChoice) {
  const list = $(id);
  unknowns.forEach(({ text }, i) => list.append(new Option(text, String(i))));
  list.value = String(chosen);
  list.addEventListener("change", () => {
    onChoice(Number(list.value));
    schedule("all");
  });
}

$("arrangement").hidden = unknowns.length < 2;
$("time-label").innerHTML = data.time.symbol;
views.legend = unknowns.map((unknown, i) =>
  legendEntry($("legend"), unknown, i, state.visible[i], () => {
    state.visible[i] = !state.visible[i];
    arrange();
    return state.visible[i];
  }),
);
views.controls = parameters.map((parameter, j) =>
  parameterControl($("parameters"), parameter, j, (value) => {
    state.p[j] = value;
    schedule("all");
  }),
);
if (!parameters.length) $("controls-title").textContent = "This solution";
arrange();
views.events = $("events") && eventList($("events"), model.events, timeDigits);
views.phase = $("phase") && phasePlot($("phase-plot"), data, state);
views.shares = $("shares") && sharesBars($("bars"), data, state);
if (views.phase) {
  choice("phase-x", state.phase[0], (i) => (state.phase[0] = i));
  choice("phase-y", state.phase[1], (i) => (state.phase[1] = i));
}
if (views.shares) choice("shares-of", 0, (i) => (state.sharesOf = i));

/** Tell the style how much room is beside the curves, and how much they take above the sliders. */
function tellRoom() {
  const top = Math.max(20, document.querySelector("main").getBoundingClientRect().top);
  $("controls").style.setProperty("--room", `${innerHeight - top - 20}px`);
  document.documentElement.style.setProperty("--stuck", `${$("curves").offsetHeight}px`);
}
new ResizeObserver(tellRoom).observe($("curves"));
addEventListener("scroll", tellRoom, { passive: true });
addEventListener("resize", tellRoom);

// ---- What people do -----------------------------------------------------------------------------

$("time").addEventListener("input", () => {
  const [first, end] = data.time.range;
  setTime(first + ((end - first) * Number($("time").value)) / STEPS);
});
$("play").addEventListener("click", play);
$("reset").addEventListener("click", reset);
$("link").addEventListener("click", copyLink);
$("csv").addEventListener("click", saveTable);
$("load").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", loadFile);
$("fit").addEventListener("click", fitAndSay);
$("theme").addEventListener("click", () => {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  keepTheme(theme === systemTheme() ? null : theme);
  recolour(theme);
});
systemDark.addEventListener("change", () => recolour(chosenTheme() ?? systemTheme()));
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
 * `times` and `curves` by unknown, `shares` (first, total) by parameter; with events `events` (times
 * and names) and `end`, after which values are NaN. `set({name: value})` sets parameters and time,
 * or throws and changes nothing. `load(text)` takes a table of measurements, and `fit()` sets the
 * parameters that fit them best and returns what it found out. `latencies` are milliseconds from what
 * somebody did to the end of the drawing.
 */
window.rankone = {
  values: () => (drawWaiting(), {
    time: state.time,
    parameters: presentParameters(),
    values: Object.fromEntries(unknowns.map(({ name }, i) => [name, state.values[i]])),
    times: [...state.times],
    curves: Object.fromEntries(unknowns.map(({ name }, i) => [name, [...state.curves[i]]])),
    shares: views.shares
      ? Object.fromEntries(views.shares.values().map((s, j) => [parameters[j].name, s]))
      : null,
    ...(data.stretches && { events: state.happenings, end: state.end }),
  }),
  set,
  load,
  fit: () => {
    const { squares, atBounds, unseen } = fit();
    const names = (positions) => positions.map((j) => parameters[j].name);
    return { squares, atBounds: names(atBounds), unseen: names(unseen) };
  },
  table,
  latencies,
};

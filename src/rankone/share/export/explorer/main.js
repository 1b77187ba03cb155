/** The page is set up. */

import { areAlike } from "./values.js";
import { phasePlot } from "./phase.js";
import { sharesBars } from "./shares.js";
import { legendEntry } from "./legend.js";
import { eventList } from "./events.js";
import { $, data, state } from "./state.js";
import { evaluateModel } from "./trajectory.js";
import { drawWaiting, latencies, showAll, timeDigits } from "./frames.js";
import { arrange, views } from "./drawing.js";
import { choice, control, openPage, presentParameters, readLink, set } from "./moves.js";
import { fit, fitAndSay, load, loadFile, saveTable, table } from "./actions.js";

const { unknowns, parameters } = data;

// ---- What is shown at first ---------------------------------------------------------------------

openPage();
if (unknowns.some(({ derivative }) => !derivative)) {
  unknowns.forEach(({ derivative }, i) => (state.visible[i] &&= !derivative));
}
const seen = unknowns.filter((_, i) => state.visible[i]);
const most = innerWidth <= 900 ? 8 : 3; // a narrow page keeps one plot in sight
state.together =
  seen.length <= most &&
  new Set(seen.map(({ unit }) => unit)).size < 2 &&
  areAlike(seen.map(({ extent }) => extent));
evaluateModel(true);

// ---- Parts --------------------------------------------------------------------------------------

$("arrangement").hidden = unknowns.length < 2;
views.legend = unknowns.map((unknown, i) =>
  legendEntry($("legend"), unknown, i, state.visible[i], () => {
    state.visible[i] = !state.visible[i];
    arrange();
    return state.visible[i];
  }),
);
control();
arrange();
views.events = $("events") && eventList($("events"), model.events, timeDigits);
views.phase = $("phase") && phasePlot($("phase-plot"), data, state);
views.shares = $("shares") && sharesBars($("bars"), data, state);
const texts = unknowns.map(({ text }) => text);
if (views.phase) {
  choice("phase-x", texts, state.phase[0], (i) => (state.phase[0] = i));
  choice("phase-y", texts, state.phase[1], (i) => (state.phase[1] = i));
}
if (views.shares) choice("shares-of", texts, 0, (i) => (state.sharesOf = i));

// ---- What people do -----------------------------------------------------------------------------

$("csv").addEventListener("click", saveTable);
$("load").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", loadFile);
$("fit").addEventListener("click", fitAndSay);
$("arrangement").addEventListener("click", ({ target }) => {
  if (!target.dataset.together) return;
  state.together = target.dataset.together === "true";
  arrange();
});
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

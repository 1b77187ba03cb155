/** What people do with curves: tables of them, measurements beside them, fits. */

import { fitParameters } from "./fitting.js";
import { readMeasurements } from "./measurements.js";
import { toTable } from "./values.js";
import { arrange, views } from "./drawing.js";
import { drawWaiting, showAll } from "./frames.js";
import { shown } from "./looks.js";
import { say } from "./moves.js";
import { $, data, state } from "./state.js";
import { visibleRows } from "./trajectory.js";

/** The curves that are shown, and the parameters, as text. */
export function table() {
  const { unknowns, parameters, time } = data;
  drawWaiting();
  const rows = visibleRows();
  const curves = rows.map((i) => state.curves[i]);
  const known = (t, k) => t <= state.end && !curves.some((curve) => Number.isNaN(curve[k]));
  const kept = [...state.times.keys()].filter((k) => known(state.times[k], k));
  // names alone, as they are read again
  const heads = [time.name, ...rows.map((i) => unknowns[i].name), ...parameters.map((p) => p.name)];
  const columns = [state.times, ...curves].map((column) => kept.map((k) => column[k]));
  const fixed = parameters.map((_, j) => Array(kept.length).fill(state.p[j]));
  return toTable(heads, [...columns, ...fixed]);
}

export function saveTable() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([table()], { type: "text/csv" }));
  link.download = `${document.title.replace(/[^\p{L}\p{N}]+/gu, "_")}.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** Take the measurements of a table: they are drawn beside the curves. An error if it has none. */
export function load(text) {
  const measurements = readMeasurements(text, data);
  state.measurements = measurements;
  for (const { row } of measurements.series) {
    state.visible[row] = true;
    views.legend[row].press(true);
  }
  for (const [j, value] of measurements.held) state.p[j] = value;
  $("fit").hidden = !data.parameters.length;
  arrange();
  showMeasured();
  showAll();
  return measurements;
}

/** Where plots stand side by side and scroll, begin with one that has measurements. */
function showMeasured() {
  const k = visibleRows().indexOf(state.measurements.series[0].row);
  const { offsetLeft } = state.together ? $("plots") : $("plots").children[k];
  $("plots").scrollLeft = offsetLeft - $("plots").offsetLeft;
}

export async function loadFile() {
  const [file] = $("file").files;
  if (!file) return;
  $("file").value = "";
  try {
    const { count, held, pooled } = load(await file.text());
    const names = [...held.keys()].map((j) => data.parameters[j].text);
    const fixed = names.length ? ` It fixes ${names.join(", ")}.` : "";
    const together = pooled.length
      ? ` A page fits one experiment: rows that differ in ${pooled.join(" and ")} count as the same.`
      : "";
    say(`${count} measurements of ${file.name} are drawn as rings.${fixed}${together}`, together);
  } catch (error) {
    say(`${file.name} cannot be used: ${error.message}.`, true);
  }
}

/** Set the parameters that fit the measurements best. */
export function fit() {
  const result = fitParameters(model, data.parameters, state.measurements, state.p);
  state.p.set(result.p);
  showAll();
  return result;
}

export function fitAndSay() {
  try {
    const { squares, free, atBounds, unseen } = fit();
    const { count, series, weighted } = state.measurements;
    const named = (positions) => positions.map((j) => data.parameters[j].text).join(", ");
    const deviations = series.map(({ row, values: { length } }, i) => {
      const { text, unit } = data.unknowns[row];
      return `${text} ${shown(Math.sqrt(squares[i] / length), 3)} ${weighted ? "sigma" : unit}`.trim();
    });
    const sentences = [
      `Fitted ${named(free)} to ${count} measurements.`,
      `Root mean square deviation: ${deviations.join(", ")}.`,
    ];
    if (unseen.length) sentences.push(`Not determined: ${named(unseen)}; other values fit as well.`);
    if (atBounds.length) sentences.push(`At an end of its range: ${named(atBounds)}.`);
    say(sentences.join(" "), unseen.length || atBounds.length);
  } catch (error) {
    say(`There is no fit: ${error.message}.`, true);
  }
}

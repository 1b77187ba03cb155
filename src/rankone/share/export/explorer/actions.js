/** What happens: values set, links, tables, time that goes on. */

import { fitParameters } from "./fitting.js";
import { readMeasurements } from "./measurements.js";
import { fromFragment, toFragment, toTable } from "./values.js";
import { arrange, drawWaiting, setTime, showAll, views } from "./drawing.js";
import { shown, unbroken } from "./looks.js";
import { $, data, start, state, visibleRows } from "./state.js";

const SECONDS = 8; // to play from start to end
const ranges = new Map([...data.parameters, data.time].map(({ name, range }) => [name, range]));

/** Start anew, also after a reload: the values of a link go from the address. */
export function reset() {
  start();
  $("notice").hidden = true;
  showAll();
  if (location.hash) history.replaceState(null, "", location.href.replace(/#.*/s, ""));
}

/** Set some parameters, or time, by name. What cannot be shown is an error, and changes nothing. */
export function set(values) {
  const p = state.p.slice();
  let time = state.time;
  for (const [name, value] of Object.entries(values)) {
    if (typeof value !== "number") throw new TypeError(`${name} is ${String(value)}, not a number`);
    const j = data.parameters.findIndex((parameter) => parameter.name === name);
    if (j >= 0) p[j] = value;
    else if (name === data.time.name) time = value;
    else throw new RangeError(`there is no ${name}`);
  }
  model.evaluate(time, p);
  state.p.set(p);
  state.time = time;
  showAll();
}

/** Parameters by name. */
export const presentParameters = () =>
  Object.fromEntries(data.parameters.map(({ name }, j) => [name, state.p[j]]));

export function readLink() {
  const fragment = location.hash.slice(1);
  if (!fragment || $(fragment)) return; // a place of this page
  const { values, problems } = fromFragment(fragment, ranges);
  set(values);
  $("notice").hidden = true;
  if (problems.length) say(`The link could not be followed altogether: ${problems.join("; ")}.`);
}

export async function copyLink() {
  const present = { ...presentParameters(), [data.time.name]: state.time };
  history.replaceState(null, "", `#${toFragment(present)}`);
  try {
    await navigator.clipboard.writeText(location.href);
    say("The link with the present values is copied.");
  } catch {
    say("The address of this page is now the link with the present values: copy it from there.");
  }
}

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

/** Show a notice, a doubtful one in the colours of a warning. */
function say(text, doubtful = false) {
  const notice = $("notice");
  notice.hidden = false;
  notice.textContent = unbroken(text);
  notice.classList.toggle("doubtful", Boolean(doubtful));
  notice.scrollIntoView({ block: "nearest" });
}

export function play() {
  cancelAnimationFrame(state.frame);
  const [first, end] = data.time.range;
  state.playing = !state.playing;
  $("play").classList.toggle("playing", state.playing);
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (!state.playing) return;
  if (state.time >= end) state.time = first;
  let before = performance.now();
  const step = (now) => {
    if (!state.playing) return;
    setTime(Math.min(end, state.time + (Math.max(0, now - before) / 1000 / SECONDS) * (end - first)));
    before = now;
    if (state.time >= end) play();
    else state.frame = requestAnimationFrame(step);
  };
  state.frame = requestAnimationFrame(step);
}

/** The curves at the present parameters, and the events that they have. */

import { timesWithEvents } from "./values.js";
import { data, state } from "./state.js";

let flat;

Object.assign(state, {
  times: data.times, // of the curves; events move them
  curves: [],
  happenings: [], // times of events, with their names
  timed: true, // whether it is known when events happen
  end: Infinity, // after it there are no values
  values: new Float64Array(data.unknowns.length),
  visible: data.unknowns.map((_, i) => i < 8),
  together: true,
  phase: [0, Math.min(1, data.unknowns.length - 1)],
  sharesOf: 0,
  measurements: null, // from a table
});

/** Room for curves at the present times. */
function makeRoom() {
  const count = state.times.length;
  flat = new Float64Array(data.unknowns.length * count);
  state.curves = data.unknowns.map((_, i) => flat.subarray(i * count, (i + 1) * count));
}

makeRoom();

/** Events move with the parameters, and with them the times of curves. */
function moveEvents() {
  const borders = model.borders(state.p);
  const order = model.branch?.(state.p) ?? 0;
  const stretches = data.stretches[order] ?? Array.from(borders, () => [0]); // where none surely holds
  state.timed = !Number.isNaN(borders[0]);
  state.end = state.timed ? model.end(state.p) : data.time.range[1];
  state.times = timesWithEvents(data.times, stretches, borders, data.time.range);
  state.happenings = happenings();
  makeRoom();
}

/** Times of events in their order, each with the names of those that happen then. */
function happenings() {
  const names = new Map();
  for (const event of model.events) {
    for (const time of model.eventTimes(event, state.p)) {
      if (!Number.isNaN(time)) names.set(time, [...(names.get(time) ?? []), event]);
    }
  }
  const times = [...names.keys()].sort((a, b) => a - b);
  return times.map((time) => ({ time, names: names.get(time) }));
}

/** Ask the model for the values at the present time, and for the curves where `all` changed. */
export function evaluateModel(all) {
  if (all && data.stretches) moveEvents();
  if (all) model.curve(state.p, state.times, flat);
  model.evaluate(state.time, state.p, state.values);
}

/** The unknowns that are shown. */
export const visibleRows = () => data.unknowns.map((_, i) => i).filter((i) => state.visible[i]);

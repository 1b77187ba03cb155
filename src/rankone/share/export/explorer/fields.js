/** Entries of fields at the present time and parameters: modes times what the model gives. */

import { data, state } from "./state.js";

const room = new Float64Array(model.names.length * data.times.length);
const count = data.times.length;

Object.assign(state, {
  coefficients: new Float64Array(model.names.length),
  entries: data.fields.map(({ entries }) => new Float64Array(entries)),
  picture: 0, // which one is shown
  // of the ordinary unknowns, as plots of curves take them
  times: data.times,
  values: new Float64Array(data.unknowns.length),
  curves: data.unknowns.map(({ row }) => room.subarray(row * count, (row + 1) * count)),
  happenings: [],
  measurements: null,
  together: false,
});

/** The numbers of base64 of little-endian float32. */
export function numbersOf(base64) {
  const text = atob(base64);
  const view = new DataView(new ArrayBuffer(text.length));
  for (let k = 0; k < text.length; k++) view.setUint8(k, text.charCodeAt(k));
  return Float32Array.from({ length: text.length / 4 }, (_, k) => view.getFloat32(4 * k, true));
}

const modes = data.fields.map((field) => numbersOf(field.modes));

/** Ask the model for coefficients, and make the entries of them; the curves too where `all` changed. */
export function evaluateFields(all) {
  if (all && data.unknowns.length) model.curve(state.p, state.times, room);
  model.evaluate(state.time, state.p, state.coefficients);
  data.unknowns.forEach(({ row }, i) => (state.values[i] = state.coefficients[row]));
  data.fields.forEach(({ first, entries }, k) => {
    const width = modes[k].length / entries;
    multiply(modes[k], state.coefficients.subarray(first, first + width), state.entries[k]);
  });
}

/** A matrix, row by row, times a vector. */
function multiply(matrix, vector, out) {
  for (let i = 0, at = 0; i < out.length; i++) {
    let sum = 0;
    for (let j = 0; j < vector.length; j++) sum += matrix[at++] * vector[j];
    out[i] = sum;
  }
}

/** Along each axis how far the places of a layout have moved; null for what does not move. */
export function movesOf({ displacement }) {
  if (!displacement?.length) return null;
  return displacement.map(({ name, positions }) => {
    const field = data.fields.findIndex((one) => one.name === name);
    return Float64Array.from(positions, (i) => state.entries[field][i]);
  });
}

/** The numbers of a picture: entries of a field, or lengths of a displacement. */
export function numbersIn({ field, layout }) {
  if (field !== null) return state.entries[field];
  const [xs, ys] = movesOf(data.layouts[layout]);
  return xs.map((x, i) => Math.hypot(x, ys[i]));
}

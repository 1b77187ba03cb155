/** What the page has from Python, and everything that changes. */

export const $ = (id) => document.getElementById(id);
export const data = JSON.parse($("data").textContent);

const count = data.times.length;
const flat = new Float64Array(data.unknowns.length * count);

export const state = {
  p: new Float64Array(data.parameters.length),
  time: 0,
  curves: data.unknowns.map((_, i) => flat.subarray(i * count, (i + 1) * count)),
  values: new Float64Array(data.unknowns.length),
  visible: data.unknowns.map((_, i) => i < 8),
  together: true,
  phase: [0, Math.min(1, data.unknowns.length - 1)],
  sharesOf: 0,
  playing: false,
  frame: 0, // the next one of playing
};

/** Ask the model for the values at the present time, and for the curves where `all` changed. */
export function evaluateModel(all) {
  if (all) model.curve(state.p, data.times, flat);
  model.evaluate(state.time, state.p, state.values);
}

/** The values at which the page opens: the median of every parameter, the beginning of time. */
export function start() {
  data.parameters.forEach(({ median }, j) => (state.p[j] = median));
  state.time = data.time.range[0];
}

/** The unknowns that are shown. */
export const visibleRows = () => data.unknowns.map((_, i) => i).filter((i) => state.visible[i]);

/** What a page has from Python, and what people change. */

export const $ = (id) => document.getElementById(id);
export const data = JSON.parse($("data").textContent);

/** Parts of the page add to it what they show. */
export const state = {
  p: new Float64Array(data.parameters.length),
  time: 0,
  playing: false,
  frame: 0, // the next one of playing
};

/** The values at which the page opens: the median of every parameter, a time at which much varies. */
export function start() {
  data.parameters.forEach(({ median }, j) => (state.p[j] = median));
  state.time = data.time.start;
}

/** Sobol indices at the present time as bars. */

import { between } from "./values.js";

/** @param {object} state the present values: `time`, `sharesOf` (an unknown) */
export function sharesBars(place, data, state) {
  const { sobol, parameters } = data;
  const rows = parameters.map(({ symbol }) => {
    const row = document.createElement("li");
    row.innerHTML =
      `<span>${symbol}</span><span class="track" aria-hidden="true"><i class="total"></i><i class="first"></i></span>` +
      '<span class="numbers"></span>';
    place.append(row);
    return row;
  });
  const absent = data.terminal ? "not defined" : "nothing varies"; // some may have ended
  const of = (kind, j) => between(sobol.times, sobol[kind][state.sharesOf][j], state.time);
  return {
    /** Shares (first, total) of each parameter; null where the variance vanishes. */
    values: () => parameters.map((_, j) => [of("first", j), of("total", j)]),
    update() {
      rows.forEach((row, j) => {
        const [first, total] = [of("first", j), of("total", j)];
        row.querySelector(".first").style.width = `${100 * (first ?? 0)}%`;
        row.querySelector(".total").style.width = `${100 * (total ?? 0)}%`;
        const text = first === null ? absent : `${percent(first)}, ${percent(total)}`;
        row.querySelector(".numbers").textContent = text;
      });
    },
  };
}

function percent(share) {
  const value = 100 * Math.min(1, Math.max(0, share));
  return `${value > 0 && value < 9.95 ? value.toFixed(1) : value.toFixed(0)} %`;
}

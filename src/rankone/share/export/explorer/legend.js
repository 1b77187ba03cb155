/** Names of the unknowns with their values, which show and hide their curves. */

import { dashOf, shown } from "./looks.js";

/** The symbol of something, and its unit in brackets. */
export function symbolWithUnit({ symbol, unit }) {
  const holder = document.createElement("span");
  holder.innerHTML = `${symbol} <span class="unit"></span>`;
  holder.querySelector(".unit").textContent = unit && `[${unit}]`;
  return holder.innerHTML;
}

/** Below this a value of an unknown is noise: its error, or rounding where that is not known. */
function noiseOf({ error, extent }) {
  return (error ?? 1e-15) * Math.max(...extent.map(Math.abs));
}

/**
 * The entry of one unknown.
 *
 * @param {HTMLElement} place where it goes
 * @param {object} unknown
 * @param {number} i its position, for the looks of its line
 * @param {boolean} visible whether its curve is shown
 * @param {() => boolean} toggle shows or hides it, and says whether it is shown then
 */
export function legendEntry(place, unknown, i, visible, toggle) {
  const item = document.createElement("li");
  item.innerHTML =
    '<button type="button"><svg class="line" width="22" height="4" aria-hidden="true">' +
    `<path d="M0 2h22" style="--own: var(--c${i % 8})" stroke-dasharray="${dashOf(i)}"/></svg>` +
    `${unknown.symbol}<span class="reading"><span class="value"></span> <span class="unit"></span></span></button>`;
  const button = item.firstElementChild;
  const value = item.querySelector(".value");
  item.querySelector(".unit").textContent = unknown.unit;
  button.title = "Show or hide";
  button.setAttribute("aria-pressed", String(visible));
  button.addEventListener("click", () => button.setAttribute("aria-pressed", String(toggle())));
  place.append(item);
  const noise = noiseOf(unknown);
  return {
    /** Mark its curve as shown or hidden. */
    press: (shows) => button.setAttribute("aria-pressed", String(shows)),
    show(number) {
      const ended = Number.isNaN(number);
      value.textContent = ended ? "–" : shown(Math.abs(number) < noise ? 0 : number);
    },
  };
}

/** A slider and a number field for each parameter. */

import { STEPS, stepAt, valueAt } from "./values.js";
import { digitsOf } from "./looks.js";

/**
 * The controls of one parameter.
 *
 * @param {HTMLElement} place where they go
 * @param {object} parameter name, symbol, unit, range and distribution
 * @param {number} number its position, for ids
 * @param {(value: number) => void} onValue called with every new value inside of the range
 */
export function parameterControl(place, parameter, number, onValue) {
  const { name, symbol, unit, range, distribution } = parameter;
  const [lower, upper] = range;
  const digits = 1 + digitsOf(range);
  const short = (value) => String(Number(value.toPrecision(digits))).replaceAll("-", "−");
  const box = document.createElement("div");
  box.className = "parameter";
  box.innerHTML =
    `<div class="row"><label for="p${number}">${symbol} <span class="unit"></span></label>` +
    '<input type="number" step="any" inputmode="decimal"></div>' +
    `<input type="range" id="p${number}" min="0" max="${STEPS}" step="1">` +
    '<div class="ends"><span></span><span></span><span></span></div>' +
    `<p class="wrong" id="w${number}" role="alert" hidden></p>`;
  const slider = box.querySelector('[type="range"]');
  const field = box.querySelector('[type="number"]');
  const wrong = box.querySelector(".wrong");
  const [left, middle, right] = box.querySelectorAll(".ends span");
  box.querySelector(".unit").textContent = unit && `[${unit}]`;
  field.setAttribute("aria-label", `${name} as a number`);
  field.setAttribute("aria-describedby", wrong.id);
  Object.assign(field, { min: lower, max: upper });
  left.textContent = short(lower);
  middle.textContent = distribution && `~ ${distribution}`;
  right.textContent = short(upper);
  let present;

  function complain(text) {
    wrong.hidden = !text;
    wrong.textContent = text;
    field.setAttribute("aria-invalid", String(Boolean(text)));
  }

  function show(value, except) {
    present = value;
    complain("");
    if (except !== field) field.value = String(value);
    if (except !== slider) slider.value = String(stepAt(range, value));
    slider.setAttribute("aria-valuetext", `${name} ${value} ${unit}`.trim());
  }

  slider.addEventListener("input", () => {
    show(valueAt(range, Number(slider.value)), slider);
    onValue(present);
  });
  field.addEventListener("input", () => {
    const value = field.valueAsNumber;
    if (!(value >= lower && value <= upper)) {
      complain(`A number from ${lower} to ${upper}; the curves are those of ${present}.`);
      return;
    }
    show(value, field);
    onValue(value);
  });
  field.addEventListener("change", () => {
    if (field.getAttribute("aria-invalid") === "true") show(present);
  });
  place.append(box);
  return { show };
}

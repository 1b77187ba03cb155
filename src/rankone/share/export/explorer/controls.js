/** A slider and a number field for each parameter. */

import { STEPS, numberFrom, stepAt, stepped, valueAt } from "./values.js";
import { digitsOf, unbroken } from "./looks.js";

/** How many steps of the slider the keys of a number field go. */
const KEYS = { ArrowUp: 1, ArrowDown: -1, PageUp: 10, PageDown: -10 };

/**
 * The controls of one parameter.
 *
 * @param {HTMLElement} place where they go
 * @param {object} parameter name, symbol, unit, range, distribution and scale
 * @param {number} number its position, for ids
 * @param {(value: number) => void} onValue called with every new value inside of the range
 */
export function parameterControl(place, parameter, number, onValue) {
  const { name, symbol, unit, range, distribution, scale } = parameter;
  const [lower, upper] = range;
  const digits = 1 + digitsOf(range);
  const short = (value) => String(Number(value.toPrecision(digits)));
  const box = document.createElement("div");
  box.className = "parameter";
  box.innerHTML =
    `<div class="row"><label for="p${number}">${symbol}</label><span class="quantity">` +
    '<input type="text" role="spinbutton" autocomplete="off" spellcheck="false">' +
    '<span class="unit"></span></span></div>' +
    `<div class="ends"><span></span><input type="range" id="p${number}" min="0" max="${STEPS}" step="1">` +
    '<span></span></div><p class="spread"></p>' +
    `<p class="wrong" id="w${number}" role="alert" hidden></p>`;
  const slider = box.querySelector('[type="range"]');
  const field = box.querySelector('[type="text"]');
  const wrong = box.querySelector(".wrong");
  const [left, right] = box.querySelectorAll(".ends span");
  box.querySelector(".unit").textContent = unit;
  field.inputMode = lower < 0 ? "text" : "decimal"; // some keys for decimals have no minus
  field.style.minWidth = `calc(${digits + 2}ch + 18px)`;
  field.setAttribute("aria-label", `${name} as a number`);
  field.setAttribute("aria-describedby", wrong.id);
  field.setAttribute("aria-valuemin", String(lower));
  field.setAttribute("aria-valuemax", String(upper));
  left.textContent = short(lower).replaceAll("-", "−");
  box.querySelector(".spread").textContent = unbroken(distribution);
  right.textContent = short(upper).replaceAll("-", "−");
  let present;
  let settled; // the value to return to if what is typed ends as refused

  function complain(text) {
    wrong.hidden = !text;
    wrong.textContent = text.replaceAll("-", "−");
    field.setAttribute("aria-invalid", String(Boolean(text)));
  }

  const refuse = () =>
    complain(`A number from ${lower} to ${upper}; the curves are those of ${short(present)}.`);

  /** Show a value everywhere but where it is being changed. */
  function show(value, except) {
    present = value;
    complain("");
    if (except !== field) {
      settled = value;
      field.value = short(value);
    }
    if (except !== slider) slider.value = String(stepAt(range, value, scale));
    slider.setAttribute("aria-valuetext", `${name} ${short(value)} ${unit}`.trim());
    field.setAttribute("aria-valuenow", String(value));
  }

  function take(value, except) {
    show(value, except);
    onValue(value);
  }

  slider.addEventListener("input", () => take(valueAt(range, Number(slider.value), scale), slider));
  field.addEventListener("input", () => {
    const value = numberFrom(field.value);
    if (value >= lower && value <= upper) take(value, field);
    else refuse();
  });
  field.addEventListener("change", () => {
    if (field.getAttribute("aria-invalid") === "true") {
      take(settled, field); // what is refused stays, to be mended
      refuse();
    } else settled = present;
  });
  field.addEventListener("keydown", (event) => {
    if (event.key === "Escape") take(settled);
    if (!(event.key in KEYS)) return;
    event.preventDefault();
    take(stepped(range, present, KEYS[event.key] * (event.shiftKey ? 10 : 1), scale));
  });
  place.append(box);
  return { show };
}

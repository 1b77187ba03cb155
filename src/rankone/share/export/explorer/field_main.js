/** The page of fields is set up. */

import { digitsOf, shown } from "./looks.js";
import { symbolWithUnit } from "./legend.js";
import { curvesPlot } from "./curves.js";
import { colours } from "./palette.js";
import { $, data, state } from "./state.js";
import { drawWaiting, latencies, page, schedule, setTime, showAll, timeText } from "./frames.js";
import { evaluateFields, numbersIn } from "./fields.js";
import { fieldPicture } from "./picture.js";
import { choice, control, openPage, presentParameters, readLink, set } from "./moves.js";

const SETTLED = 700; // milliseconds without a change after which the values are read out
const { unknowns, parameters, pictures, layouts } = data;
let picture = null;
let curves = [];
let toSay = 0;

const present = () => pictures[state.picture];

// ---- What is drawn ------------------------------------------------------------------------------

page.draw = (all) => {
  evaluateFields(all);
  picture.update();
  for (const plot of curves) all ? plot.update() : plot.mark();
  unknowns.forEach(({ unit }, i) => ($(`value${i}`).textContent = `${shown(state.values[i])} ${unit}`));
  tell();
};

page.redraw = () => {
  picture?.redraw();
  curves.forEach((plot) => plot.redraw());
};

/** A number of the present picture with its unit. */
function told(value) {
  const { range, unit, error } = present();
  const noise = (error ?? 1e-7) * Math.max(...range.map(Math.abs)); // what is smaller is not known
  return `${shown(Math.abs(value) < noise ? 0 : value, Math.min(7, digitsOf(range)))} ${unit}`.trim();
}

/** Say between which values the picture is: at once to the eye, after a pause to the ear. */
function tell() {
  const values = numbersIn(present());
  let [least, most] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < least) least = value;
    if (value > most) most = value;
  }
  const text = `${present().text} from ${told(least)} to ${told(most)} at ${data.time.text} = ${timeText()}`;
  $("extremes").textContent = text;
  const { kind, names } = layouts[present().layout];
  const over = kind === "mesh" ? "the mesh" : names.join(" and ");
  $("picture").setAttribute("aria-label", `${kind === "line" ? "Curve" : "Colours"} of ${present().text} over ${over}: ${text}`);
  clearTimeout(toSay);
  toSay = setTimeout(() => state.playing || ($("said").textContent = text), SETTLED);
}

/** The plot of the chosen picture, and its bar of colours. */
function show() {
  picture?.remove();
  $("picture").replaceChildren();
  const { layout, range } = present();
  picture = fieldPicture($("picture"), present(), layouts[layout]);
  $("colours").hidden = layouts[layout].kind === "line";
  const middle = range[0] + (range[1] - range[0]) / 2;
  [range[0], middle, range[1]].forEach((value, k) => ($("colours").querySelectorAll("b")[k].textContent = told(value)));
}

function drawBar() {
  const canvas = $("bar");
  canvas.width = colours.length;
  canvas.height = 1;
  const context = canvas.getContext("2d");
  const image = context.createImageData(colours.length, 1);
  image.data.set(colours.flatMap((rgb) => [...rgb, 255]));
  context.putImageData(image, 0, 0);
}

/** A plot over time of an ordinary unknown. */
function curveOf(unknown, i) {
  const figure = document.createElement("div");
  figure.className = "plot";
  figure.innerHTML = `<h3>${symbolWithUnit(unknown)} <span class="reading" id="value${i}"></span></h3>`;
  figure.setAttribute("role", "img");
  figure.setAttribute("aria-label", `Curve of ${unknown.text} over ${data.time.text}`);
  $("plots").append(figure);
  return curvesPlot(figure, data, [i], state, 190, setTime);
}

// ---- What people do -----------------------------------------------------------------------------

openPage();
evaluateFields(true);
drawBar();
if ($("shown")) {
  const texts = pictures.map(({ text }) => text);
  choice("shown", texts, state.picture, (k) => {
    state.picture = k;
    show();
  });
}
show();
curves = unknowns.map(curveOf);
control();
showAll();
readLink();

/**
 * For scripts: what the page shows.
 *
 * `values()` is what is drawn: `time`, `parameters` by name, `fields` by name, entry by entry, and
 * `values` of the ordinary unknowns, `times` and their `curves`; `picture` is the text of the one that
 * is shown, `range` that of its colours. `set({name: value})` sets parameters and time, or throws and
 * changes nothing; `show(k)` shows the picture at a position. `latencies` are milliseconds from what
 * somebody did to the end of the drawing.
 */
window.rankone = {
  values: () => (drawWaiting(), {
    time: state.time,
    parameters: presentParameters(),
    fields: Object.fromEntries(data.fields.map(({ name }, k) => [name, [...state.entries[k]]])),
    values: Object.fromEntries(unknowns.map(({ name }, i) => [name, state.values[i]])),
    times: [...state.times],
    curves: Object.fromEntries(unknowns.map(({ name }, i) => [name, [...state.curves[i]]])),
    picture: present().text,
    range: [...present().range],
  }),
  set,
  show(k) {
    state.picture = k;
    if ($("shown")) $("shown").value = String(k);
    show();
    schedule("all");
  },
  latencies,
};

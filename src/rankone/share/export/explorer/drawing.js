/** What is drawn of curves, and how they are arranged. */

import { curvesPlot } from "./curves.js";
import { page, setTime, timeText } from "./frames.js";
import { symbolWithUnit } from "./legend.js";
import { $, data, state } from "./state.js";
import { evaluateModel, visibleRows } from "./trajectory.js";

/** The parts of the page that show values; some pages have no phase plot or no shares. */
export const views = { plots: [], phase: null, shares: null, events: null, legend: [] };

page.draw = (all) => {
  const { plots, phase, shares } = views;
  evaluateModel(all);
  for (const part of [...plots, phase, shares]) {
    if (all || part === shares) part?.update();
    else part?.mark();
  }
  if (all) views.events?.show(state.happenings, state.timed);
  if (shares) $("shares-time").textContent = `${data.time.text} = ${timeText()}`;
  views.legend.forEach((entry, i) => entry.show(state.values[i]));
};

page.redraw = () => {
  views.plots.forEach((plot) => plot.redraw());
  views.phase?.redraw();
};

/** Plots of the unknowns that are visible: one, or one each. */
export function arrange() {
  views.plots.forEach((plot) => plot.remove());
  const place = $("plots");
  place.replaceChildren();
  place.classList.toggle("apart", !state.together);
  $("curves").classList.toggle("together", state.together);
  for (const button of $("arrangement").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", String(button.dataset.together === String(state.together)));
  }
  const rows = visibleRows();
  const groups = state.together ? [rows] : rows.map((i) => [i]);
  const narrow = innerWidth <= 900;
  const low = Math.max(150, Math.min(230, 0.24 * innerHeight)) - (state.together ? 0 : 18); // sliders go below
  const height = narrow ? low : state.together ? 380 : groups.length > 2 ? 190 : 260;
  views.plots = groups.filter((group) => group.length).map((group) => plotOf(place, group, height));
}

function plotOf(place, group, height) {
  const { unknowns, time } = data;
  const figure = document.createElement("div");
  figure.className = "plot";
  if (!state.together) figure.innerHTML = `<h3>${symbolWithUnit(unknowns[group[0]])}</h3>`;
  figure.setAttribute("role", "img");
  figure.setAttribute(
    "aria-label",
    `Curves of ${group.map((i) => unknowns[i].text).join(", ")} over ${time.text}`,
  );
  place.append(figure);
  return curvesPlot(figure, data, group, state, height, setTime);
}

/** Curves over time, with bands behind them and a mark at the present time. */

import { around, between, jumpsAt } from "./values.js";
import { axis, colour, dashOf, digitsOf, follow, ownColour, textWithUnit } from "./looks.js";
import { drawTicks } from "./events.js";

/** How strong the bands are; weaker where there are many. */
const band = (count) => (count > 3 ? 0.09 : 0.17);

/**
 * One plot of some unknowns.
 *
 * @param {HTMLElement} place where it goes
 * @param {object} data what the page shows
 * @param {number[]} rows the unknowns
 * @param {object} state the present values: `time`, `times`, `curves`, `happenings`; `together` if
 *   lines are dashed
 * @param {number} height
 * @param {(t: number) => void} onTime called when somebody points at a time
 */
export function curvesPlot(place, data, rows, state, height, onTime) {
  const { times, unknowns, time } = data;
  const measured = () => (state.measurements?.series ?? []).filter(({ row }) => rows.includes(row));
  let range = around([
    ...rows.map((i) => unknowns[i].extent),
    ...measured().map(({ values }) => [Math.min(...values), Math.max(...values)]),
  ]);
  const series = [{}];
  const bands = [];
  const edges = []; // of bands: the position among the columns, and values at the times of the data
  const columns = [state.times];
  const paths = data.stretches ? { paths: brokenLine } : {};
  for (const i of rows) {
    const hidden = { width: 0, points: { show: false }, stroke: "transparent" };
    if (unknowns[i].low) {
      bands.push({ series: [series.length, series.length + 1], fill: () => ownColour(i, band(rows.length)) });
      series.push({ ...hidden }, { ...hidden });
      edges.push([columns.length, unknowns[i].high], [columns.length + 1, unknowns[i].low]);
      columns.push(unknowns[i].high, unknowns[i].low);
    }
  }
  fitBands();
  const first = series.length;
  for (const i of rows) {
    const dash = state.together ? dashOf(i).map((length) => length * devicePixelRatio) : [];
    series.push({ stroke: () => ownColour(i), dash, width: 2.2, pxAlign: 0, points: { show: false }, ...paths });
    columns.push(state.curves[i]);
  }
  const plot = new uPlot(
    {
      width: place.clientWidth || 600,
      height,
      padding: [8, 22, 0, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: () => time.range }, y: { range: () => range } },
      axes: [axis(2, textWithUnit(time)), axis(3)],
      series,
      bands,
      hooks: { draw: [drawMark] },
    },
    columns,
    place,
  );
  const observer = follow(plot, place, () => height);
  plot.over.addEventListener("click", point);
  plot.over.addEventListener("pointerdown", (event) => {
    if (!state.together && event.pointerType === "touch") return; // a finger scrolls plots side by side
    plot.over.setPointerCapture(event.pointerId);
    point(event);
  });
  plot.over.addEventListener("pointermove", (event) => {
    if (plot.over.hasPointerCapture(event.pointerId)) point(event);
  });

  function point(event) {
    const { left } = plot.over.getBoundingClientRect();
    onTime(Math.min(time.range[1], Math.max(time.range[0], plot.posToVal(event.clientX - left, "x"))));
  }

  /** Bands at the times of curves, which events move. */
  function fitBands() {
    if (!data.stretches) return;
    columns[0] = state.times;
    for (const [k, edge] of edges) columns[k] = Array.from(state.times, (t) => between(times, edge, t));
  }

  function drawMark(u) {
    const { ctx, bbox } = u;
    drawTicks(u, state.happenings, digitsOf(time.range));
    for (const one of measured()) drawMeasurements(u, one);
    const x = u.valToPos(state.time, "x", true);
    ctx.save();
    ctx.strokeStyle = colour("soft", 0.7);
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    for (const i of rows) dot(ctx, x, u.valToPos(state.values[i], "y", true), ownColour(i));
    ctx.restore();
  }

  return {
    /** Draw the present curves; the range grows where they leave it. */
    update() {
      fitBands();
      rows.forEach((i, k) => (columns[first + k] = state.curves[i]));
      for (const i of rows) {
        for (const value of state.curves[i]) {
          if (value < range[0] || value > range[1]) range = around([range, [value, value]]);
        }
      }
      plot.setData(columns);
    },
    /** Draw the mark alone anew. */
    mark: () => plot.redraw(false, false),
    /** Draw all anew, in the present colours. */
    redraw: () => plot.redraw(true, true),
    remove() {
      observer.disconnect();
      plot.destroy();
    },
  };
}

/** Measurements as rings, with bars of one standard deviation where it is known. */
function drawMeasurements(u, { row, times, values, sigma, weighted }) {
  const { ctx } = u;
  ctx.save();
  ctx.strokeStyle = ownColour(row);
  ctx.fillStyle = colour("card");
  ctx.lineWidth = 1.6 * devicePixelRatio;
  ctx.setLineDash([]);
  times.forEach((t, i) => {
    const [x, y] = [u.valToPos(t, "x", true), u.valToPos(values[i], "y", true)];
    ctx.beginPath();
    if (weighted) {
      ctx.moveTo(x, u.valToPos(values[i] - sigma[i], "y", true));
      ctx.lineTo(x, u.valToPos(values[i] + sigma[i], "y", true));
      ctx.stroke();
      ctx.beginPath();
    }
    ctx.arc(x, y, 3.6 * devicePixelRatio, 0, 2 * Math.PI);
    ctx.fill();
    ctx.stroke();
  });
  ctx.restore();
}

/** The path of a line that begins anew after a jump; where there is no value there is no line. */
function brokenLine(plot, k) {
  const [xs, ys] = [plot.data[0], plot.data[k]];
  const jumps = jumpsAt(xs);
  const stroke = new Path2D();
  let last = NaN;
  ys.forEach((value, i) => {
    const [x, y] = [plot.valToPos(xs[i], "x", true), plot.valToPos(value, "y", true)];
    if (Number.isNaN(last) || (jumps[i] && Math.abs(y - last) >= 1)) stroke.moveTo(x, y);
    else stroke.lineTo(x, y);
    last = y;
  });
  return { stroke, fill: null, clip: null, band: null, gaps: null, flags: 0 };
}

/** A dot with a rim of the colour behind it. */
export function dot(ctx, x, y, fill) {
  ctx.beginPath();
  ctx.arc(x, y, 5 * devicePixelRatio, 0, 2 * Math.PI);
  ctx.fillStyle = fill;
  ctx.strokeStyle = colour("card");
  ctx.lineWidth = 2 * devicePixelRatio;
  ctx.fill();
  ctx.stroke();
}

/** Two unknowns against each other; what lies behind the present time is drawn stronger, jumps dashed. */

import { around, jumpsAt } from "./values.js";
import { axis, colour, follow, textWithUnit } from "./looks.js";
import { dot } from "./curves.js";

/** @param {object} state the present values: `time`, `times`, `curves`, `values`, `phase` (two unknowns) */
export function phasePlot(place, data, state) {
  const { unknowns } = data;
  let ranges = [];
  let shownPair = "";
  const text = (k) => unknowns[state.phase[k]].text;
  const label = (k) => textWithUnit(unknowns[state.phase[k]]);
  let plot;
  let observer;

  /** Axes have their labels for good: a new pair is a new plot. */
  function make() {
    observer?.disconnect();
    plot?.destroy();
    shownPair = state.phase.join();
    place.setAttribute("role", "img");
    place.setAttribute("aria-label", `${text(1)} against ${text(0)}`);
    ranges = state.phase.map((i) => around([unknowns[i].extent]));
    const height = (width) => Math.round(Math.min(380, Math.max(250, 0.8 * width)));
    const width = place.clientWidth || 400;
    plot = new uPlot(
      {
        width,
        height: height(width),
        padding: [8, 22, 0, 0],
        legend: { show: false },
        cursor: { show: false },
        scales: {
          x: { time: false, range: () => ranges[0] },
          y: { range: () => ranges[1] },
        },
        axes: [axis(2, label(0)), axis(3, label(1))],
        series: [{}, { stroke: "transparent", points: { show: false } }],
        hooks: { draw: [draw] },
      },
      [ranges[0].slice(), ranges[1].slice()],
      place,
    );
    observer = follow(plot, place, height);
  }

  function draw(u) {
    const [xs, ys] = state.phase.map((i) => state.curves[i]);
    const { times } = state;
    const jumps = jumpsAt(times);
    let now = 0;
    while (now < times.length && times[now] <= state.time) now += 1;
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineJoin = "round";
    const end = state.phase.map((i) => state.values[i]);
    const at = (x, y) => [u.valToPos(x, "x", true), u.valToPos(y, "y", true)];
    for (const [last, strength] of [[times.length, 0.28], [now, 1]]) {
      const path = Array.from(xs.subarray(0, last), (x, i) => at(x, ys[i]));
      ctx.strokeStyle = colour("accent", strength);
      stroke(ctx, 2.2, [], () => {
        path.forEach((point, i) => (jumps[i] ? ctx.moveTo(...point) : ctx.lineTo(...point)));
        if (strength === 1) ctx.lineTo(...at(...end));
      });
      path.forEach((point, i) => {
        if (!jumps[i] || Math.hypot(point[0] - path[i - 1][0], point[1] - path[i - 1][1]) < 1) return;
        stroke(ctx, 1.4, [3, 4], () => (ctx.moveTo(...path[i - 1]), ctx.lineTo(...point)));
      });
    }
    dot(ctx, ...at(...end), colour("accent"));
    ctx.restore();
  }

  make();
  return {
    update() {
      if (shownPair !== state.phase.join()) make();
      state.phase.forEach((i, k) => {
        for (const value of state.curves[i]) {
          if (value < ranges[k][0] || value > ranges[k][1]) {
            ranges[k] = around([ranges[k], [value, value]]);
          }
        }
      });
      plot.setData([ranges[0].slice(), ranges[1].slice()]);
    },
    mark: () => plot.redraw(false, false),
    redraw: () => plot.redraw(true, true),
  };
}

/** A line along a path; lengths are those of the screen. */
function stroke(ctx, width, dash, along) {
  ctx.lineWidth = width * devicePixelRatio;
  ctx.setLineDash(dash.map((length) => length * devicePixelRatio));
  ctx.beginPath();
  along();
  ctx.stroke();
  ctx.setLineDash([]);
}

/** A field as a picture: a curve over a line, colours over a plane or a mesh. */

import { around } from "./values.js";
import { axis, colour, follow, textWithUnit } from "./looks.js";
import { shades } from "./palette.js";
import { atOneScale, bordersOf, paintCells, paintPoints, paintTriangles } from "./raster.js";
import { schedule } from "./frames.js";
import { movesOf, numbersIn } from "./fields.js";

const LARGEST = 520; // height of a picture
const SMALLEST = 170;
const BESIDE = 66; // width of the labels of an axis, with the room on the other side
const BELOW = 56; // the same of heights
const ALIKE = 4; // ratio of two axes up to which they have the same scale

/**
 * The plot of one picture.
 *
 * @param {HTMLElement} place where it goes
 * @param {object} shown what it shows: `text`, `unit`, `range` of its values
 * @param {object} layout where entries are
 */
export function fieldPicture(place, shown, layout) {
  const kinds = { line: linePlot, plane: planePlot, mesh: meshPlot };
  return kinds[layout.kind](place, shown, layout);
}

/** A plot with two axes, drawn on by its series or `draw`; `ranges()` are those of the axes. */
function plotOn(place, { heads, height, ranges, series, data, draw }) {
  const width = place.clientWidth || 600;
  const grid = { show: !draw };
  const plot = new uPlot(
    {
      width,
      height: height(width),
      padding: [8, 22, 0, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: () => ranges()[0] }, y: { range: () => ranges()[1] } },
      axes: [axis(2, heads[0]), axis(3, heads[1])].map((one) => ({ ...one, grid: { ...one.grid, ...grid } })),
      series: [{}, series],
      hooks: { drawClear: draw ? [draw] : [], setSize: [() => schedule("time")] },
    },
    data,
    place,
  );
  const observer = follow(plot, place, height);
  return {
    plot,
    redraw: () => plot.redraw(true, true),
    remove() {
      observer.disconnect();
      plot.destroy();
    },
  };
}

function linePlot(place, shown, layout) {
  place.style.maxWidth = "";
  const order = [...layout.axes[0].keys()].sort((i, j) => layout.axes[0][i] - layout.axes[0][j]);
  const xs = order.map((i) => layout.axes[0][i]);
  const ends = xs.length > 1 ? [xs[0], xs.at(-1)] : [xs[0] - 0.5, xs[0] + 0.5];
  let range = around([shown.range]);
  const drawn = plotOn(place, {
    heads: [...layout.names, textWithUnit(shown)],
    height: (width) => Math.round(Math.min(innerWidth > 900 ? 380 : 260, Math.max(220, 0.5 * width))),
    ranges: () => [ends, range],
    series: { stroke: () => colour("c0"), width: 2.2, pxAlign: 0, points: { show: false } },
    data: [xs, xs.map(() => null)],
  });
  return {
    ...drawn,
    update() {
      const values = numbersIn(shown);
      for (const value of values) {
        if (value < range[0] || value > range[1]) range = around([range, [value, value]]);
      }
      drawn.plot.setData([xs, order.map((i) => values[i])]);
    },
  };
}

/** A plot of colours: `paint` puts the present ones into an image. */
function colourPlot(place, layout, extents, equal, paint) {
  const [across, up] = extents.map(([lower, upper]) => upper - lower);
  const ratio = equal ? up / across : 0.6;
  const largest = innerWidth > 900 ? LARGEST : Math.max(SMALLEST, 0.38 * innerHeight); // sliders go below
  place.style.maxWidth = equal ? `${Math.round((largest - BELOW) / ratio + BESIDE)}px` : "";
  let ranges = extents;
  let image = null;
  const drawn = plotOn(place, {
    heads: layout.names,
    height: (width) => Math.round(Math.min(largest, Math.max(SMALLEST, ratio * (width - BESIDE) + BELOW))),
    ranges: () => ranges,
    series: { stroke: "transparent", points: { show: false } },
    data: extents.map((ends) => ends.slice()),
    draw({ ctx, bbox }) {
      const [left, top, width, height] = [bbox.left, bbox.top, bbox.width, bbox.height].map(Math.round);
      if (!(width > 0 && height > 0)) return;
      if (image?.width !== width || image?.height !== height) image = ctx.createImageData(width, height);
      paint({ pixels: new Uint32Array(image.data.buffer), width, height, ranges });
      ctx.putImageData(image, left, top);
    },
  });
  return {
    ...drawn,
    update() {
      const { width, height } = drawn.plot.bbox;
      ranges = equal && width > 0 && height > 0 ? atOneScale(extents, width, height) : extents;
      drawn.plot.setData(ranges.map((ends) => ends.slice()));
    },
  };
}

function planePlot(place, shown, layout) {
  const borders = layout.axes.map(bordersOf);
  const extents = borders.map((ends) => [Math.min(ends[0], ends.at(-1)), Math.max(ends[0], ends.at(-1))]);
  const [across, up] = extents.map(([lower, upper]) => upper - lower);
  const equal = Math.max(across / up, up / across) <= ALIKE;
  const shade = shades(shown.range);
  return colourPlot(place, layout, extents, equal, (image) => paintCells(image, borders, numbersIn(shown), shade));
}

function meshPlot(place, shown, layout) {
  const shade = shades(shown.range);
  const { axes, triangles } = layout;
  const extents = layout.extents.map((ends) => around([ends]));
  return colourPlot(place, layout, extents, true, (image) => {
    const moves = movesOf(layout);
    const places = moves ? axes.map((axis, k) => axis.map((x, i) => x + moves[k][i])) : axes;
    const values = numbersIn(shown);
    if (triangles) paintTriangles(image, places, triangles, values, shade);
    else paintPoints(image, places, radiusFor(image, values.length), values, shade);
  });
}

/** Points fill about a third of the picture, within what can be seen and told apart. */
function radiusFor({ width, height }, count) {
  const radius = Math.sqrt((width * height) / (3 * Math.PI * count));
  return Math.min(8, Math.max(1.5, radius / devicePixelRatio)) * devicePixelRatio;
}

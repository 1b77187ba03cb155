/**
 * Pixels of fields: cells of a plane, triangles and points of a mesh.
 *
 * An image has `pixels`, a Uint32Array row by row from the top, its `width` and `height`, and the
 * `ranges` of x and y that it shows. `shade` makes a pixel of a number.
 */

/** The borders of the cells around places that ascend or descend: halfway between two places. */
export function bordersOf(places) {
  const last = places.length - 1;
  const length = last > 0 ? 0 : 1;
  const before = last > 0 ? places[0] - (places[1] - places[0]) / 2 : places[0] - length / 2;
  const after = last > 0 ? places[last] + (places[last] - places[last - 1]) / 2 : places[0] + length / 2;
  return [before, ...places.slice(1).map((x, i) => (places[i] + x) / 2), after];
}

/** For each pixel along an axis the cell that its middle is in; -1 outside. */
function cellsAlong(count, [first, last], borders) {
  const ascends = borders.at(-1) > borders[0];
  const sorted = ascends ? borders : [...borders].reverse();
  const cells = new Int32Array(count);
  const step = (last - first) / count;
  for (let pixel = 0, k = 0; pixel < count; pixel++) {
    const x = first + (pixel + 0.5) * step;
    while (k < sorted.length && sorted[k] <= x) k += 1;
    const inside = k > 0 && k < sorted.length;
    cells[pixel] = !inside ? -1 : ascends ? k - 1 : sorted.length - 1 - k;
  }
  return cells;
}

/** Cells of a plane: entry i * (number of cells along y) + j is at x[i], y[j]. */
export function paintCells({ pixels, width, height, ranges }, [xBorders, yBorders], values, shade) {
  const columns = cellsAlong(width, ranges[0], xBorders);
  const rows = cellsAlong(height, ranges[1], yBorders).reverse(); // the first row is the top
  const count = yBorders.length - 1;
  const colours = Uint32Array.from(values, shade);
  for (let row = 0, at = 0; row < height; row++) {
    for (let column = 0; column < width; column++, at++) {
      const inside = columns[column] >= 0 && rows[row] >= 0;
      pixels[at] = inside ? colours[columns[column] * count + rows[row]] : 0;
    }
  }
}

/** Places in pixels, from the left and from the top. */
function placed({ width, height, ranges: [[left, right], [bottom, top]] }, [xs, ys]) {
  const across = Float64Array.from(xs, (x) => ((x - left) / (right - left)) * width);
  const down = Float64Array.from(ys, (y) => ((top - y) / (top - bottom)) * height);
  return [across, down];
}

/** Triangles with values at their corners, linear in between; a later one hides an earlier one. */
export function paintTriangles(image, places, triangles, values, shade) {
  const { pixels, width, height } = image;
  const [xs, ys] = placed(image, places);
  pixels.fill(0);
  for (let k = 0; k < triangles.length; k += 3) {
    const [a, b, c] = [triangles[k], triangles[k + 1], triangles[k + 2]];
    const area = (xs[b] - xs[a]) * (ys[c] - ys[a]) - (xs[c] - xs[a]) * (ys[b] - ys[a]);
    if (!area) continue;
    const middle = (p) => Math.ceil(p - 0.5); // the first pixel whose middle is not before p
    const firstRow = Math.max(0, middle(Math.min(ys[a], ys[b], ys[c])));
    const lastRow = Math.min(height - 1, Math.floor(Math.max(ys[a], ys[b], ys[c]) - 0.5));
    const firstColumn = Math.max(0, middle(Math.min(xs[a], xs[b], xs[c])));
    const lastColumn = Math.min(width - 1, Math.floor(Math.max(xs[a], xs[b], xs[c]) - 0.5));
    for (let row = firstRow; row <= lastRow; row++) {
      const y = row + 0.5;
      for (let column = firstColumn; column <= lastColumn; column++) {
        const x = column + 0.5;
        const v = ((x - xs[a]) * (ys[c] - ys[a]) - (xs[c] - xs[a]) * (y - ys[a])) / area;
        const w = ((xs[b] - xs[a]) * (y - ys[a]) - (x - xs[a]) * (ys[b] - ys[a])) / area;
        if (v < -EDGE || w < -EDGE || v + w > 1 + EDGE) continue;
        pixels[row * width + column] = shade(values[a] + v * (values[b] - values[a]) + w * (values[c] - values[a]));
      }
    }
  }
}

/** How far outside a triangle a pixel still is its own, so that rounding leaves no gap between two. */
const EDGE = 1e-9;

/** Points as discs. */
export function paintPoints(image, places, radius, values, shade) {
  const { pixels, width, height } = image;
  const [xs, ys] = placed(image, places);
  pixels.fill(0);
  values.forEach((value, i) => {
    const colour = shade(value);
    for (let row = Math.max(0, Math.ceil(ys[i] - radius - 0.5)); row < height; row++) {
      const reach = radius ** 2 - (row + 0.5 - ys[i]) ** 2;
      if (reach < 0) break;
      const half = Math.sqrt(reach);
      const last = Math.min(width - 1, Math.floor(xs[i] + half - 0.5));
      for (let column = Math.max(0, Math.ceil(xs[i] - half - 0.5)); column <= last; column++) {
        pixels[row * width + column] = colour;
      }
    }
  });
}

/** Ranges of x and y that show given ones with the same scale along both axes. */
export function atOneScale(ranges, width, height) {
  const lengths = ranges.map(([lower, upper]) => upper - lower);
  const scale = Math.max(lengths[0] / width, lengths[1] / height);
  return ranges.map(([lower, upper], k) => {
    const half = (scale * [width, height][k]) / 2;
    const middle = (lower + upper) / 2;
    return [middle - half, middle + half];
  });
}

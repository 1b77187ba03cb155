/** Measurements from a table, and the parameters that fit them best. */

import { scaleOf } from "./values.js";

const SCREENED = 200; // points of the box among which searches start
const STARTS = 6;
const MOST_ITERATIONS = 300; // of one search
const SETTLED = 1e-13; // step, in widths of the box, that is rounding

/**
 * The measurements of a table with commas whose first line names the columns.
 *
 * Columns are time, unknowns, `sigma` or `sigma_x` for standard deviations, and parameters, whose
 * values are held. A table with columns of all parameters, such as a saved one, holds none of them.
 * Empty cells are left out. What cannot be read is an error that says where.
 *
 * @param {string} text
 * @param {object} data what the page has
 * @returns {{series: object[], held: Map<number, number>, weighted: boolean, count: number}}
 *   for each measured unknown its `row`, `times`, `values` and `sigma`
 */
export function readMeasurements(text, { unknowns, parameters, time }) {
  const lines = text.replace(/^\uFEFF/, "").split(/\r?\n/);
  const rows = lines.map((line, i) => [i + 1, cellsOf(line)]).filter(([, cells]) => cells.some(Boolean));
  if (!rows.length) throw new Error("the table is empty");
  const [[, heads], ...body] = rows;
  const clock = [time.name, "time"].map((name) => heads.indexOf(name)).find((k) => k >= 0);
  if (clock === undefined) throw new Error(`the table has no column ${time.name} for time`);
  const column = (name) => heads.indexOf(name);
  const numberAt = ([line, cells], k) => {
    if (k < 0 || !cells[k]) return NaN;
    const value = Number(cells[k]);
    if (!Number.isFinite(value)) throw new Error(`line ${line}: ${heads[k]} is ${cells[k]}, not a number`);
    return value;
  };
  const [first, end] = time.range;
  const series = unknowns
    .map(({ name }, row) => ({ row, name, times: [], values: [], sigma: [] }))
    .filter(({ name }) => column(name) >= 0);
  for (const line of body) {
    for (const one of series) {
      const value = numberAt(line, column(one.name));
      if (Number.isNaN(value)) continue;
      const t = numberAt(line, clock);
      if (!(t >= first && t <= end)) {
        throw new Error(`line ${line[0]}: ${time.name} = ${line[1][clock]} is not in [${first}, ${end}]`);
      }
      const own = numberAt(line, column(`sigma_${one.name}`));
      const sigma = Number.isNaN(own) ? numberAt(line, column("sigma")) : own;
      if (sigma <= 0) throw new Error(`line ${line[0]}: a standard deviation is not positive`);
      one.times.push(t);
      one.values.push(value);
      one.sigma.push(sigma);
    }
  }
  const measured = series.filter(({ values }) => values.length);
  if (!measured.length) {
    const names = unknowns.map(({ name }) => name).join(", ");
    throw new Error(`the table has no values of an unknown: name columns ${names}`);
  }
  const sigmas = measured.flatMap(({ sigma }) => sigma);
  const weighted = sigmas.every((sigma) => !Number.isNaN(sigma));
  if (!weighted) measured.forEach((one) => one.sigma.fill(1));
  measured.forEach((one) => (one.weighted = weighted));
  return { series: measured, held: heldBy(parameters, body, column, numberAt), weighted, count: sigmas.length };
}

/** The parameters with a column, by position: it has one value, which is inside of the range. */
function heldBy(parameters, body, column, numberAt) {
  const held = new Map();
  parameters.forEach(({ name, range: [lower, upper] }, j) => {
    if (column(name) < 0) return;
    const values = new Set(body.map((line) => numberAt(line, column(name))));
    const [value] = values;
    if (values.size > 1) throw new Error(`${name} differs from row to row: a page fits one experiment`);
    if (!(value >= lower && value <= upper)) throw new Error(`${name} = ${value} is not in [${lower}, ${upper}]`);
    held.set(j, value);
  });
  return held.size === parameters.length ? new Map() : held;
}

/** The cells of a line with commas; quotation marks around a cell go. */
const cellsOf = (line) => line.split(",").map((cell) => cell.trim().replace(/^"(.*)"$/, "$1"));

/**
 * The parameters with the least sum of squares, inside of their ranges.
 *
 * The method of Levenberg and Marquardt with the exact derivatives of the model, from the present
 * parameters and the best points all over the box.
 *
 * @param {object} model
 * @param {object[]} parameters their ranges and scales
 * @param {object} measurements what `readMeasurements` returns
 * @param {Float64Array} present
 * @returns {{p: Float64Array, squares: number, free: number[], atBounds: number[]}}
 */
export function fitParameters(model, parameters, measurements, present) {
  const free = parameters.map((_, j) => j).filter((j) => !measurements.held.has(j));
  if (!free.length) throw new Error("there is no parameter to fit");
  if (measurements.count < free.length) throw new Error("there are fewer measurements than parameters");
  const scales = free.map((j) => scaleOf(parameters[j]));
  const problem = { model, measurements, free, scales, present: present.slice() };
  for (const [j, value] of measurements.held) problem.present[j] = value;
  const own = free.map((j, k) => scales[k].place(problem.present[j]));
  const screened = [own, ...pointsOf(free.length)].map((z) => [squaresAt(problem, z), z]);
  screened.sort(([a], [b]) => (a < b ? -1 : a > b ? 1 : 0));
  const starts = [own, ...screened.slice(0, STARTS).map(([, z]) => z)];
  const ends = starts.map((z) => search(problem, z)).filter(({ squares }) => Number.isFinite(squares));
  if (!ends.length) throw new Error("the curves end before the measurements, wherever it was tried");
  const best = ends.reduce((a, b) => (b.squares < a.squares ? b : a));
  const atBounds = free.filter((_, k) => best.z[k] <= 0 || best.z[k] >= 1);
  return { p: parametersAt(problem, best.z), squares: best.squares, free, atBounds };
}

/** Points of the unit cube, more even than random ones. */
function pointsOf(n) {
  let phi = 2;
  for (let i = 0; i < 40; i++) phi = (1 + phi) ** (1 / (n + 1));
  return Array.from({ length: SCREENED }, (_, i) =>
    Array.from({ length: n }, (_, k) => (0.5 + (i + 1) * phi ** -(k + 1)) % 1),
  );
}

function parametersAt({ free, scales, present }, z) {
  const p = present.slice();
  free.forEach((j, k) => (p[j] = scales[k].value(z[k])));
  return p;
}

/** Residuals over sigma, in a row. */
function residualsAt({ model, measurements, ...problem }, z) {
  const p = parametersAt(problem, z);
  return measurements.series.flatMap(({ row, times, values, sigma }) => {
    const curve = model.curve(p, times).subarray(row * times.length, (row + 1) * times.length);
    return values.map((value, i) => (curve[i] - value) / sigma[i]);
  });
}

const sumOfSquares = (r) => r.reduce((sum, x) => sum + x * x, 0);
const squaresAt = (problem, z) => {
  const squares = sumOfSquares(residualsAt(problem, z));
  return Number.isNaN(squares) ? Infinity : squares;
};

/** Derivatives of the residuals, a row for each of them. */
function jacobianAt({ model, measurements, ...problem }, z) {
  const p = parametersAt(problem, z);
  const slopes = problem.free.map((_, k) => problem.scales[k].slope(z[k]));
  return measurements.series.flatMap(({ row, times, sigma }) =>
    times.map((t, i) => {
      const gradient = model.gradient(t, p);
      return problem.free.map((j, k) => (gradient[row * p.length + j] * slopes[k]) / sigma[i]);
    }),
  );
}

/** The minimum that is reached from a start. */
function search(problem, start) {
  let z = start.slice();
  let residuals = residualsAt(problem, z);
  let squares = sumOfSquares(residuals);
  let damping = 1e-3;
  for (let i = 0; i < MOST_ITERATIONS && Number.isFinite(squares); i++) {
    const jacobian = jacobianAt(problem, z);
    const slope = z.map((_, k) => jacobian.reduce((sum, row, m) => sum + row[k] * residuals[m], 0));
    const moving = z.map((x, k) => !((x <= 0 && slope[k] > 0) || (x >= 1 && slope[k] < 0)));
    let better = false;
    let length = Infinity;
    for (; !better && damping < 1e12 && length > SETTLED; damping *= better ? 0.1 : 8) {
      const step = stepOf(jacobian, slope, moving, damping);
      const trial = z.map((x, k) => Math.min(1, Math.max(0, x + step[k])));
      length = Math.max(...trial.map((x, k) => Math.abs(x - z[k])));
      const there = residualsAt(problem, trial);
      better = sumOfSquares(there) < squares;
      if (better) [z, residuals, squares] = [trial, there, sumOfSquares(there)];
    }
    damping = Math.max(damping, 1e-14);
    if (!better || length <= SETTLED) break;
  }
  return { z, squares: Number.isNaN(squares) ? Infinity : squares };
}

/** A damped Gauss-Newton step: Gaussian elimination of the normal equations. */
function stepOf(jacobian, slope, moving, damping) {
  const n = slope.length;
  const matrix = Array.from({ length: n }, (_, a) =>
    Array.from({ length: n }, (_, b) => jacobian.reduce((sum, row) => sum + row[a] * row[b], 0)),
  );
  const largest = Math.max(...matrix.map((row, k) => row[k]), 1e-300);
  const rows = matrix.map((row, a) => {
    if (!moving[a]) return [...row.map((_, b) => Number(a === b)), 0];
    const own = row.map((x, b) => (moving[b] ? x + (a === b ? damping * x + 1e-15 * largest : 0) : 0));
    return [...own, -slope[a]];
  });
  for (let k = 0; k < n; k++) {
    let pivot = k;
    for (let a = k + 1; a < n; a++) if (Math.abs(rows[a][k]) > Math.abs(rows[pivot][k])) pivot = a;
    [rows[k], rows[pivot]] = [rows[pivot], rows[k]];
    for (let a = 0; a < n; a++) {
      if (a === k || !rows[a][k]) continue;
      const factor = rows[a][k] / rows[k][k];
      for (let b = k; b <= n; b++) rows[a][b] -= factor * rows[k][b];
    }
  }
  return rows.map((row, k) => row[n] / row[k]);
}

/** The parameters that fit measurements best: those of `solution.fit` on the same table. */

import { scaleOf } from "./values.js";

const SCREENED = 200; // points of the box among which searches start
const STARTS = 6;
const MOST_ITERATIONS = 300; // of one search
const SETTLED = 1e-13; // step, in widths of the box, that is rounding
const WIDE = 0.5; // half an interval, in widths of the box, above which measurements say nothing
const FLAT = 1e-10; // information, in shares of the largest, below which there is none, whatever the noise

/**
 * The parameters of the largest likelihood, inside of their ranges.
 *
 * Standard deviations that the table does not have are estimated, one for each unknown. The method
 * of Levenberg and Marquardt with the exact derivatives of the model, from the present parameters
 * and the best points all over the box.
 *
 * @param {object} model
 * @param {object[]} parameters their ranges and scales
 * @param {object} measurements what `readMeasurements` returns
 * @param {Float64Array} present
 * @returns {{p: Float64Array, squares: number[], free: number[], atBounds: number[], unseen: number[]}}
 *   sums of squares over sigma for each series; parameters by position: those that were fitted, are
 *   at an end of their range, and may be anywhere in it
 */
export function fitParameters(model, parameters, measurements, present) {
  const free = parameters.map((_, j) => j).filter((j) => !measurements.held.has(j));
  if (!free.length) throw new Error("there is no parameter to fit");
  if (measurements.count < free.length) throw new Error("there are fewer measurements than parameters");
  const scales = free.map((j) => scaleOf(parameters[j]));
  const problem = { model, measurements, free, scales, present: present.slice() };
  for (const [j, value] of measurements.held) problem.present[j] = value;
  const own = free.map((j, k) => scales[k].place(problem.present[j]));
  const screened = [own, ...pointsOf(free.length)].map((z) => [costOf(problem, residualsAt(problem, z)), z]);
  screened.sort(([a], [b]) => (a < b ? -1 : a > b ? 1 : 0));
  const starts = [own, ...screened.slice(0, STARTS).map(([, z]) => z)];
  const ends = starts.map((z) => search(problem, z)).filter(({ cost }) => cost < Infinity);
  if (!ends.length) throw new Error("the curves end before the measurements, wherever it was tried");
  const best = ends.reduce((a, b) => (b.cost < a.cost ? b : a));
  const atBounds = free.filter((_, k) => best.z[k] <= 0 || best.z[k] >= 1);
  const wide = halfLengths(problem, best).map((half) => half > WIDE);
  return {
    p: parametersAt(problem, best.z),
    squares: squaresOf(problem, best.residuals),
    free,
    atBounds,
    unseen: free.filter((_, k) => wide[k]),
  };
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

/** The sum of squares of each series. */
function squaresOf({ measurements: { series } }, residuals) {
  let end = 0;
  return series.map(({ values: { length } }) => {
    const own = residuals.slice(end, (end += length));
    return own.reduce((sum, x) => sum + x * x, 0);
  });
}

/** -2 log of the likelihood up to a constant; standard deviations that are not given at their best. */
function costOf(problem, residuals) {
  const { series, weighted } = problem.measurements;
  const squares = squaresOf(problem, residuals);
  const each = weighted ? squares : squares.map((s, i) => series[i].values.length * Math.log(s));
  const cost = each.reduce((sum, x) => sum + x, 0);
  return Number.isNaN(cost) ? Infinity : cost;
}

/** For each residual one over its standard deviation: one, or at its best for these residuals. */
function precisionsOf(problem, residuals) {
  const { series, weighted } = problem.measurements;
  const squares = squaresOf(problem, residuals);
  return series.flatMap(({ values: { length } }, i) =>
    Array(length).fill(weighted || !squares[i] ? 1 : Math.sqrt(length / squares[i])),
  );
}

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

/** Half of a 95 % interval of each free parameter, in widths of its range; infinite without information. */
function halfLengths(problem, { z, residuals }) {
  const precisions = precisionsOf(problem, residuals);
  const jacobian = jacobianAt(problem, z).map((row, m) => row.map((x) => x * precisions[m]));
  const all = z.map(() => true);
  const largest = Math.max(...z.map((_, k) => jacobian.reduce((sum, row) => sum + row[k] * row[k], 0)));
  return z.map((_, k) => {
    const unit = z.map((_, a) => -Number(a === k));
    const variance = Math.max(0, stepOf(jacobian, unit, all, 0)[k]);
    return variance * largest > 1 / FLAT ? Infinity : 1.96 * Math.sqrt(variance);
  });
}

/** The minimum that is reached from a start. */
function search(problem, start) {
  let z = start.slice();
  let residuals = residualsAt(problem, z);
  let cost = costOf(problem, residuals);
  let damping = 1e-3;
  for (let i = 0; i < MOST_ITERATIONS && Number.isFinite(cost); i++) {
    const precisions = precisionsOf(problem, residuals);
    const jacobian = jacobianAt(problem, z).map((row, m) => row.map((x) => x * precisions[m]));
    const scaled = residuals.map((x, m) => x * precisions[m]);
    const slope = z.map((_, k) => jacobian.reduce((sum, row, m) => sum + row[k] * scaled[m], 0));
    const moving = z.map((x, k) => !((x <= 0 && slope[k] > 0) || (x >= 1 && slope[k] < 0)));
    let better = false;
    let length = Infinity;
    for (; !better && damping < 1e12 && length > SETTLED; damping *= better ? 0.1 : 8) {
      const step = stepOf(jacobian, slope, moving, damping);
      const trial = z.map((x, k) => Math.min(1, Math.max(0, x + step[k])));
      length = Math.max(...trial.map((x, k) => Math.abs(x - z[k])));
      const there = residualsAt(problem, trial);
      const lower = costOf(problem, there);
      better = lower < cost;
      if (better) [z, residuals, cost] = [trial, there, lower];
    }
    damping = Math.max(damping, 1e-14);
    if (!better || length <= SETTLED) break;
  }
  return { z, residuals, cost };
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

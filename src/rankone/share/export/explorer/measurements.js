/** Measurements from a table. */

/**
 * The measurements of a table with commas whose first line names the columns.
 *
 * Columns are time, unknowns, `sigma` or `sigma_x` for standard deviations, and parameters, whose
 * values are held. A table with columns of all parameters, such as a saved one, holds none of them.
 * Empty cells are left out. What cannot be read is an error that says where; so is a standard
 * deviation that is missing where other measurements have one.
 *
 * @param {string} text
 * @param {object} data what the page has
 * @returns {{series: object[], held: Map<number, number>, weighted: boolean, count: number,
 *   pooled: string[]}} for each measured unknown its `row`, `times`, `values` and `sigma`; columns
 *   whose labels tell experiments apart, which a page does not
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
  const sigmaOf = ({ name }) => [`sigma_${name}`, "sigma"].map(column).find((k) => k >= 0) ?? -1;
  const weighted = body.some((line) => series.some((one) => line[1][column(one.name)] && line[1][sigmaOf(one)]));
  for (const line of body) {
    for (const one of series) {
      const value = numberAt(line, column(one.name));
      if (Number.isNaN(value)) continue;
      const t = numberAt(line, clock);
      if (!(t >= first && t <= end)) {
        throw new Error(`line ${line[0]}: ${time.name} = ${line[1][clock]} is not in [${first}, ${end}]`);
      }
      const sigma = numberAt(line, sigmaOf(one));
      if (sigma <= 0) throw new Error(`line ${line[0]}: a standard deviation is not positive`);
      if (weighted && Number.isNaN(sigma)) {
        throw new Error(`line ${line[0]}: ${one.name} has no standard deviation, and other measurements have one`);
      }
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
  const count = measured.reduce((sum, { values }) => sum + values.length, 0);
  if (!weighted) measured.forEach((one) => one.sigma.fill(1));
  measured.forEach((one) => (one.weighted = weighted));
  const pooled = ["condition", "subject"].filter(
    (name) => column(name) >= 0 && new Set(body.map(([, cells]) => cells[column(name)])).size > 1,
  );
  return { series: measured, held: heldBy(parameters, body, column, numberAt), weighted, count, pooled };
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

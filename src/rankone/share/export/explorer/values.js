/** Numbers without a page: steps of sliders, values in between, links and tables. */

/** Steps of a slider from one end to the other. */
export const STEPS = 1000;

/** Coordinates in which a slider is even, by the scale of a parameter, and the way back. */
const SCALES = {
  linear: [(x) => x, (s) => s],
  log: [Math.log, Math.exp],
  reciprocal: [(x) => -1 / x, (s) => -1 / s],
};

/** A parameter as a coordinate from 0 to 1, even on its scale, and the way back with its slope. */
export function scaleOf({ range, scale = "linear" }) {
  const [to, from] = SCALES[scale];
  const [first, end] = range.map(to);
  const derivative = { linear: () => 1, log: (x) => x, reciprocal: (x) => x * x }[scale];
  const value = (z) => Math.min(range[1], Math.max(range[0], from(first + (end - first) * z)));
  return {
    place: (x) => (to(x) - first) / (end - first),
    value,
    slope: (z) => (end - first) * derivative(value(z)),
  };
}

/** The value at a step of a slider: one with few digits, inside of the range. */
export function valueAt(range, step, scale = "linear") {
  const [lower, upper] = range;
  if (step <= 0) return lower;
  if (step >= STEPS) return upper;
  const [to, from] = SCALES[scale];
  return rounded(range, from(to(lower) + ((to(upper) - to(lower)) * step) / STEPS), 3, scale);
}

/** A value some steps further. */
export function stepped(range, value, steps, scale = "linear") {
  const [to, from] = SCALES[scale];
  const [first, end] = range.map(to);
  const place = Math.min(end, Math.max(first, to(value) + ((end - first) * steps) / STEPS));
  return rounded(range, from(place), 4, scale);
}

/** A value of a range with some digits beyond those of its length, or of its own on a scale. */
function rounded([lower, upper], value, digits, scale) {
  const length = scale === "linear" ? upper - lower : value;
  const decimals = digits - Math.floor(Math.log10(length));
  const short = decimals > 20 ? value : Number(value.toFixed(Math.max(0, decimals)));
  return Math.min(upper, Math.max(lower, short));
}

/** The step of a slider that is closest to a value. */
export function stepAt([lower, upper], value, scale = "linear") {
  if (!(upper > lower)) return 0;
  const [first, end, place] = [lower, upper, value].map(SCALES[scale][0]);
  return Math.round(((place - first) / (end - first)) * STEPS);
}

/** The number that a text is, with a decimal point or a comma; NaN for what is none. */
export function numberFrom(text) {
  const plain = text.trim().replaceAll("−", "-").replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(plain) ? Number(plain) : NaN;
}

/** How far before an event a time on its earlier side is: models take closer ones as at the event. */
const beforeEvents = ([first, end]) =>
  2e-12 * (end - first) + 8 * Number.EPSILON * Math.max(Math.abs(first), Math.abs(end));

/** For each time whether a jump can lie between it and the one before: nothing else fits there. */
export function jumpsAt(times) {
  const aside = 2 * beforeEvents([times[0], times.at(-1)]);
  return times.map((t, i) => i > 0 && t - times[i - 1] <= aside);
}

/**
 * Times of curves that events move: even ones, and the given shares of each stretch between events.
 * Where one stretch ends and the next one begins there is a time on either side. A border that is
 * NaN is none.
 */
export function timesWithEvents(even, shares, borders, [first, end]) {
  const times = [...even, ...borders];
  const aside = beforeEvents([first, end]);
  shares.forEach((ofStretch, i) => {
    const length = borders[i + 1] - borders[i];
    times.push(borders[i] - aside, ...ofStretch.map((share) => borders[i] + share * length));
  });
  const ascending = Float64Array.from(times.filter((t) => t >= first && t <= end)).sort();
  return ascending.filter((t, i) => i === 0 || t > ascending[i - 1]);
}

/** Piecewise linear between (xs, ys); null where an end of the piece has no value. */
export function between(xs, ys, x) {
  let last = xs.length - 1;
  let first = 0;
  while (last - first > 1) {
    const middle = (first + last) >> 1;
    if (xs[middle] <= x) first = middle;
    else last = middle;
  }
  const share = xs[last] > xs[first] ? (x - xs[first]) / (xs[last] - xs[first]) : 0;
  if (share === 0) return ys[first];
  if (share === 1) return ys[last];
  if (ys[first] === null || ys[last] === null) return null;
  return ys[first] + share * (ys[last] - ys[first]);
}

/** Values by name as the fragment of an address. Each number is written so that it comes back. */
export function toFragment(values) {
  const pairs = Object.entries(values);
  return pairs.map(([name, value]) => `${encodeURIComponent(name)}=${value}`).join("&");
}

/**
 * Values by name from the fragment of an address, and what is wrong with it.
 *
 * Numbers outside their range become its nearest end; of several of one name the last counts.
 */
export function fromFragment(fragment, ranges) {
  const values = Object.create(null);
  const problems = [];
  for (const pair of fragment.replace(/^#/, "").split("&")) {
    if (!pair) continue;
    if (!pair.includes("=")) {
      problems.push(`${decoded(pair)} is not a name with a value`);
      continue;
    }
    const [name, text] = pair.split(/=(.*)/s).map(decoded);
    const range = ranges.get(name);
    const value = text.trim() === "" ? NaN : Number(text);
    if (!range) problems.push(`there is no ${name}`);
    else if (!Number.isFinite(value)) problems.push(`${name} = ${text} is not a number`);
    else {
      if (name in values) problems.push(`${name} is there more than once`);
      values[name] = Math.min(range[1], Math.max(range[0], value));
      if (values[name] !== value) {
        problems.push(`${name} = ${value} is not in [${range[0]}, ${range[1]}], ${values[name]} is shown`);
      }
    }
  }
  return { values, problems };
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

/** Columns as comma-separated values. */
export function toTable(heads, columns) {
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const rows = [heads.map(quoted)];
  for (let i = 0; i < columns[0].length; i++) rows.push(columns.map((column) => column[i]));
  return rows.map((row) => row.join(",")).join("\n") + "\n";
}

/** Whether one axis serves all of these intervals: no length is beyond a hundred times another. */
export function areAlike(extents) {
  const sizes = extents.map(([lower, upper]) => upper - lower).filter((size) => size > 0);
  return Math.max(0, ...sizes) <= 100 * Math.min(Infinity, ...sizes);
}

/** The interval of all of them, with a little room on both sides. */
export function around(extents) {
  let lower = Infinity;
  let upper = -Infinity;
  for (const [a, b] of extents) {
    lower = Math.min(lower, a);
    upper = Math.max(upper, b);
  }
  const room = 0.06 * (upper - lower) || 0.06 * Math.abs(upper) || 1;
  return [lower - room, upper + room];
}

// node javascript.mjs MODEL [plain]: processor time of one call of each function, in us.
import { pathToFileURL } from "node:url";

const [file, plain] = process.argv.slice(2);
if (plain) delete globalThis.WebAssembly;
const began = performance.now();
const model = await import(pathToFileURL(file));
const load = (performance.now() - began) * 1000;

const COUNT = 2000;
const REPEATS = 15;
const columns = [model.time, ...model.parameters].map((name) => {
  const [lower, upper] = model.ranges[name];
  return Float64Array.from({ length: COUNT }, () => lower + (upper - lower) * Math.random());
});
const [times, ...others] = columns;
const points = Array.from(times, (_, i) => others.map((column) => column[i]));
const named = points.map((p) => Object.fromEntries(p.map((x, j) => [model.parameters[j], x])));
const sorted = Float64Array.from(times).sort().filter((_, i) => i % 10 === 0);

const n = model.names.length;
const value = new Float64Array(n);
const slope = new Float64Array(n * model.parameters.length);
const batch = new Float64Array(n * COUNT);
const line = new Float64Array(n * sorted.length);

/** Median of the microseconds of processor time of each call. */
function measured(calls, run) {
  const found = [];
  for (let k = 0; k < REPEATS; k++) {
    const start = process.cpuUsage();
    run();
    found.push(process.cpuUsage(start).user / calls);
  }
  return found.sort((a, b) => a - b)[REPEATS >> 1];
}

function each(call) {
  return measured(COUNT, () => {
    for (let i = 0; i < COUNT; i++) call(i);
  });
}

const results = {
  load,
  evaluate: each((i) => model.evaluate(times[i], points[i], value)),
  "evaluate by name": each((i) => model.evaluate(times[i], named[i], value)),
  "evaluateBatch, a point": measured(COUNT, () => model.evaluateBatch(times, others, batch)),
  "curve, a time": each((i) => model.curve(points[i], sorted, line)) / sorted.length,
  gradient: each((i) => model.gradient(times[i], points[i], slope)),
  timeDerivative: each((i) => model.timeDerivative(times[i], points[i], value)),
};
console.log(JSON.stringify(results));

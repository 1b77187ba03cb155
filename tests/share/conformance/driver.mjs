// node driver.mjs REQUESTS: asks models at points of a file, with WebAssembly and without.
//
// A request is { model, points, answers, plain }: a module, parameters and times as JSON, where the
// answers go, and whether to do without WebAssembly.
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const plain = (values) => Array.from(values, (value) => (Number.isNaN(value) ? null : value));

/** What becomes of a call, and whether it wrote anything. */
function refused(m, call) {
  const out = new Float64Array(m.names.length * (1 + m.parameters.length)).fill(7);
  try {
    call(out);
    return "none";
  } catch (error) {
    if (!(error instanceof m.ModelError)) throw error;
    return out.every((value) => value === 7) ? error.name : "written";
  }
}

function answers(m, columns) {
  const [times, ...p] = columns;
  const points = times.map((t, i) => [t, p.map((column) => column[i])]);
  const named = (values) => Object.fromEntries(m.parameters.map((name, j) => [name, values[j]]));
  // one after the other at each point: what was found for the first is used for the others
  const each = points.map(([t, at]) => [
    plain(m.evaluate(t, named(at))),
    plain(m.gradient(t, at)),
    plain(m.timeDerivative(t, new Float64Array(at))),
  ]);
  const said = {
    values: each.map(([values]) => values),
    gradient: each.map(([, gradient]) => gradient),
    rates: each.map(([, , rates]) => rates),
    batch: plain(m.evaluateBatch(times, p)),
    unknowns: m.names,
    parameters: m.parameters,
    units: m.units,
    ranges: [m.time, ...m.parameters].map((name) => m.ranges[name]),
    curve: plain(m.curve(points[0][1], times)),
    singly: times.map((t) => plain(m.evaluate(t, points[0][1]))),
    exports: Object.keys(m),
  };
  said.refused = said.ranges.flatMap(([low, high], j) =>
    [low - (high - low), high + (high - low), NaN].map((value) => {
      const at = [points[0][0], ...points[0][1]];
      at[j] = value;
      const kinds = [m.evaluate, m.gradient, m.timeDerivative].map((ask) =>
        refused(m, (out) => ask(at[0], at.slice(1), out)));
      kinds.push(refused(m, (out) => m.evaluateBatch([at[0]], at.slice(1), out)));
      return kinds.every((kind) => kind === kinds[0]) ? kinds[0] : kinds.join();
    }));
  if (m.eventTimes) {
    const parameters = points.map(([, at]) => at);
    const out = new Float64Array(9).fill(7);
    said.times = Object.fromEntries(
      m.events.map((event) => [event, parameters.map((at) => plain(m.eventTimes(event, named(at))))]));
    said.end = plain(parameters.map((at) => m.end(at)));
    said.borders = parameters.map((at) => plain(m.borders(at)));
    said.instants = m.instants;
    said.written = m.eventTimes(m.events[0], parameters[0], out) === out && out[8] === 7;
    said.unknownEvent = refused(m, () => m.eventTimes("bonce", parameters[0]));
    said.missing = refused(m, () => (m.parameters.length ? m.end({}) : m.end([1])));
  }
  if (m.branch) said.branch = points.map(([, at]) => m.branch(at));
  return said;
}

const requests = JSON.parse(readFileSync(process.argv[2]));
const { WebAssembly } = globalThis;
for (const { model, points, answers: target, plain: without } of requests) {
  if (without) delete globalThis.WebAssembly;
  else globalThis.WebAssembly = WebAssembly;
  const module = await import(`${pathToFileURL(model)}${without ? "?plain" : ""}`);
  writeFileSync(target, JSON.stringify(answers(module, JSON.parse(readFileSync(points)))));
}

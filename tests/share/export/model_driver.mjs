// node model_driver.mjs MODEL POINTS OUT [plain]: evaluates a model at points of a file.
//
// The points are float64, (coordinates, N). Written are values (N, unknowns), the values of a
// batch (unknowns, N), gradients (N, unknowns, parameters) and time derivatives (N, unknowns).
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [file, points, target, plain] = process.argv.slice(2);
if (plain) delete globalThis.WebAssembly;
const model = await import(pathToFileURL(file));

const bytes = readFileSync(points);
const given = new Float64Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
const width = 1 + model.parameters.length;
const count = given.length / width;
const columns = [];
for (let j = 0; j < width; j++) columns.push(given.subarray(j * count, (j + 1) * count));

const results = [];
const parts = [[], [], []];
for (let i = 0; i < count; i++) {
  const [t, ...p] = columns.map((column) => column[i]);
  const named = Object.fromEntries(model.parameters.map((name, j) => [name, p[j]]));
  parts[0].push(model.evaluate(t, named));
  parts[1].push(model.gradient(t, p));
  parts[2].push(model.timeDerivative(t, new Float64Array(p)));
}
const [t, ...p] = columns;
results.push(...parts[0], model.evaluateBatch(t, p), ...parts[1], ...parts[2]);
writeFileSync(target, Buffer.concat(results.map((array) => Buffer.from(array.buffer))));

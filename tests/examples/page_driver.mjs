// node page_driver.mjs SCRIPT SEARCH: runs the script of a page with a canvas that takes notes.
//
// Two frames are drawn. Printed is a JSON object: the lines of the last frame, each as its points in
// pixels, and the texts of all elements.
import { pathToFileURL } from "node:url";

const [script, search] = process.argv.slice(2);
const texts = {};
const frames = [];
let lines = [];

function element(id) {
  const own = {
    style: {},
    append() {},
    setAttribute() {},
    addEventListener() {},
    getBoundingClientRect: () => ({ width: 400, height: 800 }),
    getContext: () => pen,
    set textContent(text) {
      texts[id] = text;
    },
  };
  return own;
}

const pen = {
  clearRect: () => (lines = []),
  beginPath: () => lines.push([]),
  moveTo: (x, y) => lines.at(-1).push([x, y]),
  lineTo: (x, y) => lines.at(-1).push([x, y]),
  stroke() {},
};

let created = 0;
Object.assign(globalThis, {
  location: { search },
  devicePixelRatio: 1,
  matchMedia: () => ({ matches: false }),
  getComputedStyle: () => ({ getPropertyValue: () => "black" }),
  requestAnimationFrame: (frame) => frames.push(frame),
  ResizeObserver: class {
    observe() {}
  },
  document: {
    documentElement: {},
    getElementById: element,
    querySelector: element,
    createElement: (tag) => element(`${tag} ${created++}`),
  },
});

await import(pathToFileURL(script));
for (const now of [1000, 1016]) frames.shift()(now);
console.log(JSON.stringify({ lines, texts }));

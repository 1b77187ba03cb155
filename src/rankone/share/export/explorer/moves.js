/** What people do with parameters and time: values set, links, time that goes on. */

import { STEPS, fromFragment, toFragment } from "./values.js";
import { chosenTheme, keepTheme, unbroken } from "./looks.js";
import { parameterControl } from "./controls.js";
import { page, recolour, schedule, setTime, showAll } from "./frames.js";
import { $, data, start, state } from "./state.js";

const SECONDS = 8; // to play from start to end
const ranges = new Map([...data.parameters, data.time].map(({ name, range }) => [name, range]));

/** Start anew, also after a reload: the values of a link go from the address. */
export function reset() {
  start();
  $("notice").hidden = true;
  showAll();
  if (location.hash) history.replaceState(null, "", location.href.replace(/#.*/s, ""));
}

/** Set some parameters, or time, by name. What cannot be shown is an error, and changes nothing. */
export function set(values) {
  const p = state.p.slice();
  let time = state.time;
  for (const [name, value] of Object.entries(values)) {
    if (typeof value !== "number") throw new TypeError(`${name} is ${String(value)}, not a number`);
    const j = data.parameters.findIndex((parameter) => parameter.name === name);
    if (j >= 0) p[j] = value;
    else if (name === data.time.name) time = value;
    else throw new RangeError(`there is no ${name}`);
  }
  model.evaluate(time, p);
  state.p.set(p);
  state.time = time;
  showAll();
}

/** Parameters by name. */
export const presentParameters = () =>
  Object.fromEntries(data.parameters.map(({ name }, j) => [name, state.p[j]]));

export function readLink() {
  const fragment = location.hash.slice(1);
  if (!fragment || $(fragment)) return; // a place of this page
  const { values, problems } = fromFragment(fragment, ranges);
  set(values);
  $("notice").hidden = true;
  if (problems.length) say(`The link could not be followed altogether: ${problems.join("; ")}.`);
}

export async function copyLink() {
  const present = { ...presentParameters(), [data.time.name]: state.time };
  history.replaceState(null, "", `#${toFragment(present)}`);
  try {
    await navigator.clipboard.writeText(location.href);
    say("The link with the present values is copied.");
  } catch {
    say("The address of this page is now the link with the present values: copy it from there.");
  }
}

/** Show a notice, a doubtful one in the colours of a warning. */
export function say(text, doubtful = false) {
  const notice = $("notice");
  notice.hidden = false;
  notice.textContent = unbroken(text);
  notice.classList.toggle("doubtful", Boolean(doubtful));
  notice.scrollIntoView({ block: "nearest" });
}

export function play() {
  cancelAnimationFrame(state.frame);
  const [first, end] = data.time.range;
  state.playing = !state.playing;
  $("play").classList.toggle("playing", state.playing);
  $("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (!state.playing) return;
  if (state.time >= end) state.time = first;
  let before = performance.now();
  const step = (now) => {
    if (!state.playing) return;
    setTime(Math.min(end, state.time + (Math.max(0, now - before) / 1000 / SECONDS) * (end - first)));
    before = now;
    if (state.time >= end) play();
    else state.frame = requestAnimationFrame(step);
  };
  state.frame = requestAnimationFrame(step);
}

const systemDark = matchMedia("(prefers-color-scheme: dark)");
const systemTheme = () => (systemDark.matches ? "dark" : "light");
const ownTheme = () => chosenTheme() ?? systemTheme();

/** Open with the colours and the values at which a page begins. */
export function openPage() {
  recolour(ownTheme());
  start();
}

/** The controls of parameters and time, and what they share with all pages. */
export function control() {
  $("time-label").innerHTML = data.time.symbol;
  page.controls = data.parameters.map((parameter, j) =>
    parameterControl($("parameters"), parameter, j, (value) => {
      state.p[j] = value;
      schedule("all");
    }),
  );
  if (!data.parameters.length) $("controls-title").textContent = "This solution";
  $("time").addEventListener("input", () => {
    const [first, end] = data.time.range;
    setTime(first + ((end - first) * Number($("time").value)) / STEPS);
  });
  $("play").addEventListener("click", play);
  $("reset").addEventListener("click", reset);
  $("link").addEventListener("click", copyLink);
  $("theme").addEventListener("click", () => {
    const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    keepTheme(theme === systemTheme() ? null : theme);
    recolour(theme);
  });
  systemDark.addEventListener("change", () => recolour(ownTheme()));
  addEventListener("hashchange", readLink);
  for (const link of document.querySelectorAll('a[href="#quality"]')) {
    link.addEventListener("click", () => ($("quality").open = true));
  }
  new ResizeObserver(tellRoom).observe($("curves"));
  addEventListener("scroll", tellRoom, { passive: true });
  addEventListener("resize", tellRoom);
}

/** Tell the style how much room is beside the curves, and how much they take above the sliders. */
function tellRoom() {
  const top = Math.max(20, document.querySelector("main").getBoundingClientRect().top);
  $("controls").style.setProperty("--room", `${innerHeight - top - 20}px`);
  document.documentElement.style.setProperty("--stuck", `${$("curves").offsetHeight}px`);
}

/** Options of a list, by their texts; `onChoice` is called with the position of the chosen one. */
export function choice(id, texts, chosen, onChoice) {
  const list = $(id);
  texts.forEach((text, i) => list.append(new Option(text, String(i))));
  list.value = String(chosen);
  list.addEventListener("change", () => {
    onChoice(Number(list.value));
    schedule("all");
  });
}

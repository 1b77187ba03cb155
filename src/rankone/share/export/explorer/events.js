/** Events: ticks on the axis of time, and names with their times. */

import { shown } from "./looks.js";

const MOST = 6; // times of one event that are written out

/** Names of events in a list; `show` writes their times beside them. */
export function eventList(place, names, digits) {
  const entries = names.map((name) => {
    const item = document.createElement("li");
    item.innerHTML = '<i class="tick"></i><span></span> <span class="when"></span>';
    item.querySelector("span").textContent = name;
    place.append(item);
    return item.querySelector(".when");
  });
  return {
    show(happenings, timed) {
      entries.forEach((entry, k) => {
        const times = happenings.filter((one) => one.names.includes(names[k]));
        const texts = times.slice(0, MOST).map(({ time }) => shown(time, digits));
        if (times.length > MOST) texts.push(`… (${times.length})`);
        entry.textContent = texts.join(", ") || (timed ? "does not happen" : "not known here");
      });
    },
  };
}

/** Put ticks where events are, which tell their names to whoever points at them. */
export function drawTicks(plot, happenings, digits) {
  const ticks = [...plot.over.querySelectorAll(".tick")];
  while (ticks.length < happenings.length) {
    ticks.push(document.createElement("i"));
    ticks.at(-1).className = "tick";
    plot.over.append(ticks.at(-1));
  }
  ticks.forEach((tick, i) => {
    tick.hidden = i >= happenings.length;
    if (tick.hidden) return;
    const { time, names } = happenings[i];
    tick.style.left = `${plot.valToPos(time, "x")}px`;
    tick.title = `${names.join(" and ")} ${shown(time, digits)}`;
  });
}

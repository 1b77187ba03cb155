/** Colours of the theme, and numbers as texts. */

const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);
const known = new Map();

/** A colour of the style sheet as the canvas takes it; with a share of its strength. */
export function colour(name, strength = 1) {
  const key = `${name} ${strength}`;
  if (!known.has(key)) {
    probe.style.color = `var(--${name})`;
    const [r, g, b] = getComputedStyle(probe).color.match(/[\d.]+/g);
    known.set(key, `rgba(${r}, ${g}, ${b}, ${strength})`);
  }
  return known.get(key);
}

/** The colour of the line of an unknown. */
export const ownColour = (i, strength) => colour(`c${i % 8}`, strength);

const DASHES = [[], [9, 4], [2.5, 3], [9, 3, 2.5, 3], [5, 3], [14, 4], [14, 3, 2.5, 3], [9, 3, 2.5, 3, 2.5, 3]];

/** The dashes of the line of an unknown, beside its colour, where it is one of several. */
export const dashOf = (i) => DASHES[i % 8];

export function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  known.clear();
}

const KEPT = "rankone-theme";

/** The theme that somebody chose, also before; null if nobody did. */
export function chosenTheme() {
  try {
    const theme = localStorage.getItem(KEPT);
    return ["dark", "light"].includes(theme) ? theme : null;
  } catch {
    return null; // a page from a disk may have no storage
  }
}

/** Remember a theme, or with null that of the system. */
export function keepTheme(theme) {
  try {
    if (theme) localStorage.setItem(KEPT, theme);
    else localStorage.removeItem(KEPT);
  } catch {
    // it lasts until the page is closed
  }
}

/** A number for people: five digits, or more if that does not tell the numbers apart. */
export function shown(value, digits = 5) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 10 ** digits || size < 1e-3) {
    return value.toExponential(digits - 2).replace("-", "−").replace("e-", "e−");
  }
  const decimals = digits - 1 - Math.max(0, Math.floor(Math.log10(size)));
  return value.toFixed(Math.max(0, decimals)).replace("-", "−");
}

/** A text whose numbers stay on one line: there are breaks after a hyphen, not after a minus. */
export const unbroken = (text) => text.replace(/(\de)-(?=\d)/g, "$1−");

/** Digits of the numbers of a range that is narrow beside their size, to tell them apart. */
export function digitsOf([lower, upper]) {
  const largest = Math.max(Math.abs(lower), Math.abs(upper));
  const further = Math.floor(Math.log10(largest / (upper - lower)));
  return Math.min(15, 5 + (Number.isFinite(further) ? Math.max(0, further) : 0));
}

/** Labels of an axis, with as many digits as tell them apart. */
export function ticks(values, step) {
  const largest = Math.max(...values.map(Math.abs));
  if (largest >= 1e5 || (largest > 0 && largest < 1e-3)) {
    const digits = Math.max(0, Math.floor(Math.log10(largest)) - Math.floor(Math.log10(step) + 1e-9));
    return values.map((value) => (value ? value.toExponential(digits).replaceAll("-", "−") : "0"));
  }
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const needed = values.every((v) => Math.abs(v - Number(v.toFixed(decimals))) < 1e-9 * step);
  return values.map((v) => v.toFixed(needed ? decimals : decimals + 1).replace("-", "−"));
}

/** The name of something, and its unit in brackets. */
export const textWithUnit = ({ text, unit }) => (unit ? `${text} [${unit}]` : text);

const FONT = '12px system-ui, -apple-system, "Segoe UI", Roboto, Arial, sans-serif';

/** An axis of a plot; `label` is written beside it. */
export function axis(side, label) {
  const measure = document.createElement("canvas").getContext("2d");
  measure.font = FONT;
  return {
    side,
    label,
    labelFont: FONT,
    labelSize: 20,
    labelGap: 2,
    font: FONT,
    stroke: () => colour("soft"),
    grid: { stroke: () => colour("grid"), width: 1 },
    ticks: { show: false },
    gap: 6,
    space: side === 2 ? 70 : 34,
    values: (u, splits, index, space, step) => ticks(splits, step),
    size: (u, values) => {
      if (side === 2) return 28;
      const widths = (values ?? []).map((text) => measure.measureText(text).width);
      return Math.ceil(Math.max(24, ...widths)) + 10;
    },
  };
}

/** Let a plot follow the width of its place. */
export function follow(plot, place, height) {
  const observer = new ResizeObserver(() => {
    const size = { width: Math.floor(place.clientWidth), height: height(place.clientWidth) };
    if (size.width > 0 && (size.width !== plot.width || size.height !== plot.height)) plot.setSize(size);
  });
  observer.observe(place);
  return observer;
}

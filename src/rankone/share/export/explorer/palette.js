/** Colours of numbers: a map in which equal steps look equally far apart, on light and dark pages. */

export const SHADES = 256;

/**
 * Lightness, chroma and hue (degrees) of OKLCH, from the smallest number to the largest: from violet
 * over teal to yellow. Neither end is as dark or as light as the page, and all are colours of sRGB.
 */
const LIGHTNESS = [0.44, 0.9];
const CHROMA = 0.11;
const HUE = [295, 105];

/** Red, green and blue from 0 to 255 of a colour of OKLab (B. Ottosson, "A perceptual color space", 2020). */
function colourOf(lightness, a, b) {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const linear = [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
  const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
  return linear.map((x) => Math.round(255 * Math.min(1, Math.max(0, encoded(x)))));
}

/** The colours of the map, [red, green, blue] each. */
export const colours = Array.from({ length: SHADES }, (_, k) => {
  const share = k / (SHADES - 1);
  const [lightness, hue] = [LIGHTNESS, HUE].map(([first, last]) => first + share * (last - first));
  const angle = (hue * Math.PI) / 180;
  return colourOf(lightness, CHROMA * Math.cos(angle), CHROMA * Math.sin(angle));
});

/** The colours as pixels: red is the first of four bytes. */
const pixels = new Uint32Array(Uint8Array.from(colours.flatMap((rgb) => [...rgb, 255])).buffer);

/** The pixel of a number, where the map spans a range: numbers beyond it have the colour of its end. */
export function shades([lower, upper]) {
  const factor = upper > lower ? (SHADES - 1) / (upper - lower) : 0;
  return (value) => pixels[Math.max(0, Math.min(SHADES - 1, Math.round((value - lower) * factor)))];
}

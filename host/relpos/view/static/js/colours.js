// Colours of people, and how well colours stand out from each other.
//
// A colour never tells anything alone: people carry their number and name, states a shape and a
// word. Nine hues, then they repeat; each at least 4.5 : 1 against its theme's map (WCAG AA).

const LIGHT = [
  "#0060a8", "#b84a00", "#00734f", "#a63a7e", "#7d5800", "#00707f", "#5b3fc4", "#7a4b2a", "#44546a",
];
const DARK = [
  "#6db7ff", "#ff9a5c", "#4fd6a4", "#f09bd0", "#f2c14e", "#5fd9e8", "#b5a3ff", "#d9a77f", "#b4c2d6",
];

/** Colour of a node's wearer; it does not change when others join. */
export function personColour(node, dark) {
  const palette = dark ? DARK : LIGHT;
  return palette[(node - 1) % palette.length];
}

export function palette(dark) {
  return [...(dark ? DARK : LIGHT)];
}

/** [r, g, b] in 0..255 of "#rrggbb". */
export function parse(hex) {
  const n = Number.parseInt(hex.trim().slice(1), 16);
  return [(n >> 16) & 255, (n >> 8) & 255, n & 255];
}

/** Relative luminance by WCAG 2. */
export function luminance(hex) {
  const [r, g, b] = parse(hex).map((value) => {
    const v = value / 255;
    return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  });
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}

/** Contrast ratio by WCAG 2: 1 to 21. */
export function contrast(a, b) {
  const [x, y] = [luminance(a), luminance(b)];
  return (Math.max(x, y) + 0.05) / (Math.min(x, y) + 0.05);
}

/** Black or white, whichever stands out more. */
export function inkOn(hex) {
  return contrast(hex, "#000000") >= contrast(hex, "#ffffff") ? "#000000" : "#ffffff";
}

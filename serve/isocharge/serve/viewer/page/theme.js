// Colours from the style sheet, for what is drawn on canvases.

const dark = matchMedia("(prefers-color-scheme: dark)");
const names = ["ground", "card", "ink", "quiet", "line", "fill", "touch", "accent", "film", "area", "warn", "deep", "flat",
  "c0", "c1", "c2", "c3", "c4", "c5", "c6", "c7"];

export const theme = {};

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of names) theme[name] = style.getPropertyValue(`--${name}`).trim();
}

/** Dashes that tell lines apart without their colours. */
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [4, 2], [1, 2], [12, 3], [9, 3, 2, 3, 2, 3]];

/** Style of the lines of an electrode: the name of its colour, its colour and its dashes. Eight electrodes differ. */
export function lineStyle(electrode) {
  const k = electrode % DASHES.length;
  return { name: `c${k}`, colour: theme[`c${k}`], dash: DASHES[k] };
}

export function onTheme(change) { dark.addEventListener("change", () => { read(); change(); }); }

/** Numbers 0 to 1 of "#rrggbb" or "#rgb". */
export function rgb(colour) {
  const digits = colour.length === 4 ? [...colour.slice(1)].map((d) => d + d) : colour.slice(1).match(/../g);
  return digits.map((pair) => parseInt(pair, 16) / 255);
}

/** Fits a canvas to its size on the screen; true where that has changed. */
export function fit(canvas, largest = 2) {
  const scale = Math.min(devicePixelRatio || 1, largest), box = canvas.getBoundingClientRect();
  const width = Math.round(box.width * scale), height = Math.round(box.height * scale);
  if (canvas.width === width && canvas.height === height) return false;
  [canvas.width, canvas.height] = [width, height];
  return true;
}

read();

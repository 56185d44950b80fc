// Colours that people with any colour vision tell apart: for numbers viridis, and for categories eight near those of Okabe and Ito,
// of which any two differ by at least 20 in CIELAB, also without the red, the green or the blue cones. The planners' pictures have
// those of the light theme.

import { svg } from "./dom.js";

const LIGHT = ["#0072b2", "#d55e00", "#16a879", "#c577a7", "#eba305", "#8ec1f1", "#7a2a6a", "#24242c"];
const DARK = ["#56b4e9", "#e69f00", "#00945d", "#d392b4", "#d15a00", "#fcec4d", "#3a6fe0", "#e2eaf3"];
const VIRIDIS = [
  "#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725",
];

const darkness = matchMedia("(prefers-color-scheme: dark)");

/** Calls `listener` when the page changes between dark and light. */
export function onThemeChange(listener) {
  darkness.addEventListener("change", listener);
}

/** The colours of categories and of indices in the present theme. */
export function categories() {
  return darkness.matches ? DARK : LIGHT;
}

/** The colour of the page behind the points, as three numbers from 0 to 1. */
export function background() {
  return rgb(getComputedStyle(document.documentElement).getPropertyValue("--card").trim()).map((part) => part / 255);
}

/** A colour text `#rrggbb` as three numbers from 0 to 255. */
export function rgb(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
}

/** 256 colours of RGBA: viridis, without its darkest end in the dark theme, where it would not be seen. */
export function ramp() {
  const [from, to] = darkness.matches ? [0.18, 1] : [0, 0.93];
  const stops = VIRIDIS.map(rgb);
  const colors = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i++) {
    const place = (from + ((to - from) * i) / 255) * (stops.length - 1);
    const left = Math.min(Math.floor(place), stops.length - 2);
    for (let part = 0; part < 3; part++) {
      colors[4 * i + part] = stops[left][part] + (place - left) * (stops[left + 1][part] - stops[left][part]);
    }
    colors[4 * i + 3] = 255;
  }
  return colors;
}

/** 256 colours of RGBA that repeat those of the categories. */
export function categoryTable() {
  const stops = categories().map(rgb);
  const colors = new Uint8Array(4 * 256);
  for (let i = 0; i < 256; i++) colors.set([...stops[i % stops.length], 255], 4 * i);
  return colors;
}

/** The ramp as a small picture for a legend. */
export function rampPicture() {
  const colors = ramp();
  const picture = svg("svg", { class: "ramp", viewBox: "0 0 64 8", preserveAspectRatio: "none", "aria-hidden": "true" });
  for (let i = 0; i < 64; i++) {
    const [red, green, blue] = colors.subarray(16 * i, 16 * i + 3);
    picture.append(svg("rect", { x: i, y: 0, width: 64 - i, height: 8, fill: `rgb(${red} ${green} ${blue})` }));
  }
  return picture;
}

// A small curve without axes, for a cell of a table.

import { svg } from "./dom.js";

const WIDTH = 72;
const HEIGHT = 20;
const LEAST_SPAN_MS = 20_000;

/** An SVG for the curve. `tone` is the class of its colour. */
export function sparkline(tone) {
  return svg(
    "svg",
    { class: `spark ${tone}`, viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", "aria-hidden": "true" },
    svg("path", { class: "under" }),
    svg("path", { class: "line" }),
  );
}

/** Draws numbers with their times. The right edge is now, and the left edge the oldest of them. */
export function draw(target, numbers, now) {
  const most = numbers.reduce((top, { value }) => Math.max(top, value), 0);
  // A curve that is 0 throughout tells nothing.
  target.classList.toggle("still", most === 0);
  const span = Math.max(LEAST_SPAN_MS, numbers.length > 0 ? now - numbers[0].at : 0);
  const x = (at) => (WIDTH * (1 - (now - at) / span)).toFixed(1);
  const y = (value) => (HEIGHT - 1.5 - (most > 0 ? (HEIGHT - 3) * (value / most) : 0)).toFixed(1);
  const steps = numbers.map(({ at, value }) => `${x(at)},${y(value)}`);
  const [under, line] = target.children;
  line.setAttribute("d", steps.length > 1 ? `M${steps.join("L")}` : "");
  const ends = steps.length > 1 ? [x(numbers[0].at), x(numbers.at(-1).at)] : [];
  under.setAttribute("d", steps.length > 1 ? `M${ends[0]},${HEIGHT}L${steps.join("L")}L${ends[1]},${HEIGHT}Z` : "");
}

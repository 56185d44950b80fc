// The probe and the lines to its neighbours, drawn above the points.

import { onScreen } from "./camera.js";
import { svg } from "./dom.js";

/** More neighbours than this hide the picture. */
export const MAX_NEIGHBORS = 300;
// A label needs this much room.
const LABEL = { width: 52, height: 15 };

/**
 * Draws the probe at `probe` and its neighbours at `neighbors`, nearest first, all as places of the picture. A neighbour
 * gets its label where that hides no other one. `highlight` is the number of a neighbour to show more strongly, or −1.
 */
export function drawMarks(target, { matrix, probe, neighbors, labels, highlight, width, height }) {
  target.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const center = probe && onScreen(matrix, probe, width, height);
  if (!center) {
    target.replaceChildren();
    return;
  }
  const ends = neighbors
    .slice(0, MAX_NEIGHBORS)
    .map((place, i) => ({ i, at: onScreen(matrix, place, width, height) }))
    .filter(({ at }) => at);
  // The nearest come last, so that they lie above the others.
  const fromFar = [...ends].reverse();
  const lines = fromFar.flatMap(({ i, at }) => [lineTo(center, at, "halo"), lineTo(center, at, i === highlight ? "link strong" : "link")]);
  const dots = fromFar.map(({ i, at }) => dot(i === highlight ? "neighbor strong" : "neighbor", at, i === highlight ? 7 : 4));
  target.replaceChildren(...lines, ...dots, ...texts(center, ends, labels), dot("probe", center, 7), dot("probe-middle", center, 2));
}

function texts(center, ends, labels) {
  const taken = [center];
  const made = [];
  for (const { i, at } of ends) {
    const isRight = at[0] >= center[0];
    const middle = [at[0] + (isRight ? 1 : -1) * (8 + LABEL.width / 2), at[1]];
    const isFree = taken.every(([x, y]) => Math.abs(x - middle[0]) > LABEL.width || Math.abs(y - middle[1]) > LABEL.height);
    if (!isFree || !labels[i]) continue;
    taken.push(middle);
    const place = { x: at[0] + (isRight ? 8 : -8), y: at[1], "text-anchor": isRight ? "start" : "end", "dominant-baseline": "middle" };
    made.push(svg("text", { class: "label", ...place, text: labels[i] }));
  }
  return made;
}

function lineTo(from, to, kind) {
  return svg("line", { class: kind, x1: from[0], y1: from[1], x2: to[0], y2: to[1] });
}

function dot(kind, at, radius) {
  return svg("circle", { class: kind, cx: at[0], cy: at[1], r: radius });
}

// The box around the points with its grid, its numbers and its names, drawn below the points.

import { onScreen } from "./camera.js";
import { svg } from "./dom.js";
import { ticksOf } from "./ticks.js";

// About the width of a character of a name.
const CHARACTER_PIXELS = 7.5;
// About that of a digit of a number.
const NUMBER_PIXELS = 6.6;

/**
 * Draws the box on an SVG of the size of the canvas. An axis that is not numbered, as one of a ring, shows no quantity of
 * its own.
 */
export function drawAxes(target, { matrix, eye, box, ranges, names, isNumbered, width, height }) {
  target.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const screen = (place) => onScreen(matrix, place, width, height);
  const made = [];
  const line = (from, to, kind) => {
    const [a, b] = [screen(from), screen(to)];
    if (a && b) made.push(svg("line", { class: kind, x1: a[0], y1: a[1], x2: b[0], y2: b[1] }));
  };
  const ticks = ranges.map((range, axis) => (box[axis] > 0 && isNumbered[axis] ? ticksOf(range) : []));
  const place = (axis, value) => ((value - ranges[axis][0]) / (ranges[axis][1] - ranges[axis][0]) - 0.5) * box[axis];
  for (const { axis, side } of backFaces(box, eye)) drawFace(axis, side);
  for (let axis = 0; axis < 3; axis++) if (box[axis] > 0) drawNumbers(axis);
  target.replaceChildren(...made);

  function drawFace(axis, side) {
    const [u, v] = [0, 1, 2].filter((other) => other !== axis);
    const at = (first, second) => {
      const corner = [0, 0, 0];
      corner[axis] = (side * box[axis]) / 2;
      corner[u] = first;
      corner[v] = second;
      return corner;
    };
    const [halfU, halfV] = [box[u] / 2, box[v] / 2];
    for (const { at: tick } of ticks[u]) line(at(place(u, tick), -halfV), at(place(u, tick), halfV), "grid");
    for (const { at: tick } of ticks[v]) line(at(-halfU, place(v, tick)), at(halfU, place(v, tick)), "grid");
    line(at(-halfU, -halfV), at(halfU, -halfV), "edge");
    line(at(halfU, -halfV), at(halfU, halfV), "edge");
    line(at(halfU, halfV), at(-halfU, halfV), "edge");
    line(at(-halfU, halfV), at(-halfU, -halfV), "edge");
  }

  function drawNumbers(axis) {
    const edge = outerEdge(axis, box, screen);
    if (!edge) return;
    const at = (value) => edge.place(place(axis, value));
    const away = edge.away;
    let last = null;
    for (const tick of ticks[axis]) {
      const on = screen(at(tick.at));
      // Numbers that would touch, or are not on the canvas, are left out.
      if (!isInside(on) || (last && Math.hypot(on[0] - last[0], on[1] - last[1]) < 32)) continue;
      last = on;
      made.push(text("number", on[0] + 13 * away[0], on[1] + 13 * away[1], tick.text, away));
    }
    const middle = screen(edge.place(0));
    if (!isInside(middle) || !names[axis]) return;
    // The name stands beyond the longest number.
    const longest = Math.max(0, ...ticks[axis].map((tick) => tick.text.length));
    const beyond = Math.max(36, 22 + NUMBER_PIXELS * longest);
    made.push(text("name", middle[0] + beyond * away[0], middle[1] + 30 * away[1], names[axis], away));
  }

  function isInside(on) {
    return on && on[0] > 0 && on[0] < width && on[1] > 0 && on[1] < height;
  }

  function text(kind, x, y, content, away = [0, 0]) {
    const anchor = away[0] > 0.5 ? "start" : away[0] < -0.5 ? "end" : "middle";
    // Long names stay on the canvas.
    const extent = CHARACTER_PIXELS * content.length;
    const [left, right] = { start: [0, extent], end: [extent, 0], middle: [extent / 2, extent / 2] }[anchor];
    const kept = Math.max(Math.min(x, width - 8 - right), 8 + left);
    return svg("text", { class: kind, x: kept, y: Math.min(y, height - 8), "text-anchor": anchor, "dominant-baseline": "middle", text: content });
  }
}

/** The faces that are behind the points. An axis without extent has one face, which is always shown. */
function backFaces(box, eye) {
  const faces = [];
  for (let axis = 0; axis < 3; axis++) {
    const others = [0, 1, 2].filter((other) => other !== axis);
    if (others.some((other) => box[other] === 0)) continue;
    if (box[axis] === 0) faces.push({ axis, side: 0 });
    else for (const side of [-1, 1]) if (side * eye[axis] < box[axis] / 2) faces.push({ axis, side });
  }
  return faces;
}

/** The edge along an axis that is outermost on the screen: below for level axes, at the left for steep ones. */
function outerEdge(axis, box, screen) {
  const [u, v] = [0, 1, 2].filter((other) => other !== axis);
  const center = screen([0, 0, 0]);
  let best = null;
  for (const [sideU, sideV] of [[-1, -1], [-1, 1], [1, -1], [1, 1]]) {
    const place = (along) => {
      const corner = [0, 0, 0];
      corner[axis] = along;
      corner[u] = (sideU * box[u]) / 2;
      corner[v] = (sideV * box[v]) / 2;
      return corner;
    };
    const [from, to] = [screen(place(-box[axis] / 2)), screen(place(box[axis] / 2))];
    if (!from || !to || !center) continue;
    const [across, down] = [to[0] - from[0], to[1] - from[1]];
    const middle = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
    const isSteep = Math.abs(down) > 1.5 * Math.abs(across);
    const score = isSteep ? -middle[0] : middle[1];
    // The numbers stand beside the edge, on the side away from the middle of the box.
    const length = Math.hypot(across, down) || 1;
    let away = [-down / length, across / length];
    if (away[0] * (middle[0] - center[0]) + away[1] * (middle[1] - center[1]) < 0) away = away.map((part) => -part);
    if (length > 24 && (!best || score > best.score)) best = { score, place, away };
  }
  return best;
}

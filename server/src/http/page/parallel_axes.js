// The parallel axes with their numbers and names, and the lines of the probe and its neighbours above the others.

import { svg } from "./dom.js";
import { MAX_NEIGHBORS } from "./marks.js";
import { ticksOf } from "./ticks.js";

// Room for the names above the axes, for numbers beside the outer ones, and for notes below.
const MARGIN = { left: 46, right: 46, top: 96, bottom: 44 };
const NARROW_MARGIN = { left: 22, right: 22, top: 132, bottom: 56 };
const NARROW_PIXELS = 560;
// Below this distance of two axes, names are turned and axes have only the numbers of their ends.
const CLOSE_PIXELS = 74;
const CHARACTER_PIXELS = 7.5;
const LABEL_PIXELS = 15;

/** The axes of a space on a canvas: where each stands, its range, its name, and its numbers. */
export function layoutOf(space, { low, high }, width, height) {
  const margin = width < NARROW_PIXELS ? NARROW_MARGIN : MARGIN;
  const apart = (width - margin.left - margin.right) / Math.max(space.coordinateCount - 1, 1);
  const [top, bottom] = [margin.top, Math.max(height - margin.bottom, margin.top + 40)];
  const isClose = apart < CLOSE_PIXELS;
  const axes = space.axes.map(({ name, range }, c) => {
    const [from, to] = range ?? [low[c], high[c]];
    const ticks = ticksOf([from, to], isClose ? 3 : Math.max(3, Math.floor((bottom - top) / 60)));
    return { x: margin.left + apart * c, low: from, high: to, name, ticks };
  });
  return { axes, top, bottom, width, height, apart, isClose };
}

/** The place of a number along an axis: 0 at its lower end, 1 at its upper end. */
export function shareOf({ low, high }, number) {
  const share = high > low ? (number - low) / (high - low) : 0.5;
  return share > 0 ? Math.min(share, 1) : 0;
}

/** Draws the axes on an SVG of the size of the canvas. */
export function drawParallelAxes(target, { axes, top, bottom, width, height, apart, isClose }) {
  target.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const made = [];
  const text = (kind, x, y, content, more = {}) => made.push(svg("text", { class: kind, x, y, "text-anchor": "middle", text: content, ...more }));
  for (const axis of axes) {
    made.push(svg("line", { class: "upright", x1: axis.x, y1: top, x2: axis.x, y2: bottom }));
    for (const { at, text: number } of axis.ticks) {
      const y = bottom - (bottom - top) * shareOf(axis, at);
      made.push(svg("line", { class: "upright", x1: axis.x - 4, y1: y, x2: axis.x, y2: y }));
      // A number that reaches the axis before is left out.
      const extent = CHARACTER_PIXELS * number.length + 8;
      if (extent > Math.max(apart - 6, 20)) continue;
      const [x, anchor] = extent > axis.x ? [axis.x + 6, "start"] : [axis.x - 7, "end"];
      text("number behind", x, y, number, { "text-anchor": anchor, "dominant-baseline": "middle" });
    }
    const isTurned = isClose || CHARACTER_PIXELS * axis.name.length > apart;
    const place = { x: axis.x, y: top - 12 };
    if (isTurned) text("name small", place.x, place.y, axis.name, { "text-anchor": "start", transform: `rotate(-50 ${place.x} ${place.y})` });
    else text("name", kept(place.x, (CHARACTER_PIXELS * axis.name.length) / 2, width), place.y, axis.name);
  }
  target.replaceChildren(...made);
}

// A place for the middle of a text, so that its halves stay on the canvas.
function kept(x, half, width) {
  return Math.max(half + 8, Math.min(x, width - half - 8));
}

/** Draws the probe and its neighbours, nearest first, as rows of coordinates. */
export function drawParallelMarks(target, layout, { probe, neighbors, labels, highlight }) {
  target.setAttribute("viewBox", `0 0 ${layout.width} ${layout.height}`);
  const { axes, top, bottom } = layout;
  const placesOf = (row) => axes.map((axis, c) => [axis.x, bottom - (bottom - top) * shareOf(axis, row[c])]);
  const line = (places, kind) => svg("polyline", { class: `${kind} hollow`, points: places.map((place) => place.join()).join(" ") });
  if (!probe) {
    target.replaceChildren();
    return;
  }
  // The nearest come last, so that they lie above the others.
  const others = neighbors.slice(0, MAX_NEIGHBORS).map((row, i) => ({ places: placesOf(row), i })).reverse();
  const isStrong = ({ i }) => i === highlight;
  const ordered = [...others.filter((one) => !isStrong(one)), ...others.filter(isStrong)];
  const own = placesOf(probe);
  target.replaceChildren(
    ...ordered.map(({ places }) => line(places, "halo")),
    ...ordered.map((one) => line(one.places, isStrong(one) ? "link strong" : "link")),
    line(own, "halo"),
    line(own, "link own"),
    ...own.map(([x, y]) => svg("circle", { class: "probe", cx: x, cy: y, r: 4.5 })),
    ...labelsOf([...others].reverse(), labels),
  );
}

// The distances stand beside the last axis, where there is room.
function labelsOf(lines, labels) {
  const taken = [];
  const made = [];
  for (const { places, i } of lines) {
    const [x, y] = places.at(-1);
    if (!labels[i] || taken.some((other) => Math.abs(other - y) < LABEL_PIXELS)) continue;
    taken.push(y);
    made.push(svg("text", { class: "label", x: x + 6, y, "dominant-baseline": "middle", text: labels[i] }));
  }
  return made;
}

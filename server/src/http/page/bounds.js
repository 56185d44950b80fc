// The bounds of the coordinates of all indices in a picture.

const FIRST_MARGIN = 0.03;
const LATER_MARGIN = 0.15;

/** Bounds that grow with the points, by more than is needed, so that they grow rarely. */
export class Bounds {
  constructor(coordinateCount) {
    this.low = new Float64Array(coordinateCount).fill(Infinity);
    this.high = new Float64Array(coordinateCount).fill(-Infinity);
  }

  /** True if the points of a cloud made the bounds wider. */
  include(cloud) {
    if (cloud.length === 0) return false;
    let isWider = false;
    for (let c = 0; c < this.low.length; c++) {
      const [low, high] = [cloud.low[c], cloud.high[c]];
      if (low >= this.low[c] && high <= this.high[c]) continue;
      const isFirst = this.low[c] > this.high[c];
      const [least, most] = [Math.min(low, this.low[c]), Math.max(high, this.high[c])];
      // All points at one place get a box around them.
      const span = most - least || Math.max(Math.abs(most) * 0.1, 1e-6);
      const margin = span * (isFirst ? FIRST_MARGIN : LATER_MARGIN);
      if (low < this.low[c]) this.low[c] = least - margin;
      if (high > this.high[c]) this.high[c] = most + margin;
      isWider = true;
    }
    return isWider;
  }

  /** These bounds, or from 0 to 1 while there are no points. */
  orUnit() {
    if (this.low[0] <= this.high[0]) return this;
    return { low: this.low.map(() => 0), high: this.high.map(() => 1) };
  }
}

/** The edges of the box in the picture: the longest is 1, and axes of one unit share their scale. */
export function boxOf({ ranges, units }) {
  const spans = ranges.map(([low, high]) => high - low);
  const longest = (unit) => Math.max(...spans.filter((_, axis) => units[axis] === unit));
  // A box that is nearly flat along an axis would hide what happens there.
  return spans.map((span, axis) => (span > 0 ? Math.max(span / longest(units[axis]), 0.15) : 0));
}

/** The point of the picture for a projected point, whose middle is 0. */
export function placeInBox(point, ranges, box) {
  return [0, 1, 2].map((axis) => {
    const [low, high] = ranges[axis];
    return high > low ? ((point[axis] - low) / (high - low) - 0.5) * box[axis] : 0;
  });
}

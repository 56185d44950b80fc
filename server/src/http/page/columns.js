// Typed arrays that grow.

const LEAST_LENGTH = 4096;

/** The column itself if it has `least` elements, or a larger copy whose new elements are `filler`. */
export function grown(column, least, filler = 0) {
  if (least <= column.length) return column;
  const larger = new column.constructor(Math.max(least, LEAST_LENGTH, 2 * column.length));
  if (filler !== 0) larger.fill(filler, column.length);
  larger.set(column);
  return larger;
}

// Finds the point at a place of the canvas.

import { ALIVE } from "./cloud.js";

// The pointer means the nearer to the eye of two points at about the same place: the whole depth counts as this many pixels.
const DEPTH_PIXELS = 8;

/** The layer and slot of the vertex nearest to (x, y) within `maxPixels` pixels, among those that are there at `revision`. */
export function pick(layers, { matrix, box, revision, width, height }, x, y, maxPixels) {
  let best = null;
  let least = maxPixels + DEPTH_PIXELS;
  // The matrix applied to vertices as they are stored, from 0 to 65535.
  const m = matrix;
  const scale = box.map((edge) => edge / 65535);
  for (const layer of layers) {
    const { halves, words, length } = layer.vertices;
    for (let slot = 0; slot < length; slot++) {
      const died = words[4 * slot + 3];
      if (words[4 * slot + 2] > revision || (died !== ALIVE && died <= revision)) continue;
      const a = halves[8 * slot] * scale[0] - box[0] / 2;
      const b = halves[8 * slot + 1] * scale[1] - box[1] / 2;
      const c = halves[8 * slot + 2] * scale[2] - box[2] / 2;
      const w = m[3] * a + m[7] * b + m[11] * c + m[15];
      if (w <= 0) continue;
      const right = (width * (1 + (m[0] * a + m[4] * b + m[8] * c + m[12]) / w)) / 2 - x;
      if (right > maxPixels || right < -maxPixels) continue;
      const down = (height * (1 - (m[1] * a + m[5] * b + m[9] * c + m[13]) / w)) / 2 - y;
      const apart = right * right + down * down;
      if (apart > maxPixels * maxPixels) continue;
      const depth = (m[2] * a + m[6] * b + m[10] * c + m[14]) / w;
      const score = Math.sqrt(apart) + (DEPTH_PIXELS * (depth + 1)) / 2;
      if (score >= least) continue;
      least = score;
      best = { layer, slot };
    }
  }
  return best;
}

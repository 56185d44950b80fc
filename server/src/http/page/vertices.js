// The vertices of a cloud, 16 bytes each: three places and a colour of 16 bits, and the revisions of birth and death.

/** The bytes of a vertex. */
export const VERTEX_BYTES = 16;
const STEPS = 65535;

/** Vertices in memory, as the graphics processor gets them. */
export class Vertices {
  constructor() {
    this.#allocate(4096);
    this.length = 0;
  }

  /** Encodes the slots [from, to) of a cloud. `colorOf(slot)` gives 16 bits. */
  encode(cloud, from, to, { ranges, project }, colorOf) {
    if (to > this.capacity) this.#grow(to);
    const { halves, words } = this;
    const { rows, born, died, coordinateCount } = cloud;
    const scales = ranges.map(([low, high]) => (high > low ? STEPS / (high - low) : 0));
    const lows = ranges.map(([low]) => low);
    const out = new Float64Array(3);
    for (let slot = from; slot < to; slot++) {
      project(rows, slot * coordinateCount, out);
      const half = 8 * slot;
      for (let axis = 0; axis < 3; axis++) {
        // Infinite and foreign numbers end at the border of the box.
        const step = scales[axis] === 0 ? STEPS / 2 : (out[axis] - lows[axis]) * scales[axis];
        halves[half + axis] = step > 0 ? (step < STEPS ? step + 0.5 : STEPS) : 0;
      }
      halves[half + 3] = colorOf(slot);
      words[4 * slot + 2] = born[slot];
      words[4 * slot + 3] = died[slot];
    }
    this.length = cloud.length;
  }

  /** The bytes of the slots [from, to). */
  bytes(from, to) {
    return new Uint8Array(this.halves.buffer, VERTEX_BYTES * from, VERTEX_BYTES * (to - from));
  }

  #allocate(capacity) {
    this.capacity = capacity;
    this.halves = new Uint16Array(8 * capacity);
    // The revisions are read from the same bytes.
    this.words = new Uint32Array(this.halves.buffer);
  }

  #grow(least) {
    const old = this.halves;
    this.#allocate(Math.max(least, 2 * this.capacity));
    this.halves.set(old);
  }
}

// The edges of a cloud: pairs of slots. A server tells them for indices whose payloads are the ids of neighbours.

// More edges hide the picture, and each takes 8 bytes here and in the graphics processor.
const MAX_EDGES = 3_000_000;

/** Edges that grow. */
export class Edges {
  /** Pairs of slots, of which the first `length` pairs count. */
  pairs = new Uint32Array(0);
  length = 0;
  /** Counts how often pairs moved: what was built from them has to be built again. */
  generation = 0;
  // Edges whose other end has not come yet: the slot, and the id of that end.
  #waiting = [];
  // Per slot, 1 if it has told its edges.
  #told = new Uint8Array(0);

  /** Takes an `edges` frame: the ids of one end, then those of the other. `slots` finds the slot of an id. */
  append({ count }, body, slots) {
    const ids = new Uint32Array(body, 0, 4 * count);
    const again = new Set();
    const from = new Int32Array(count);
    for (let i = 0; i < count; i++) {
      from[i] = slots.get(ids[2 * i], ids[2 * i + 1]);
      if (from[i] >= 0 && this.#told[from[i]]) again.add(from[i]);
    }
    // A point that tells its edges again has only those.
    if (again.size > 0) this.#keep((a) => !again.has(a));
    for (let i = 0; i < count; i++) {
      if (from[i] < 0) continue;
      this.#mark(from[i]);
      const at = 2 * (count + i);
      this.#join(from[i], ids[at], ids[at + 1], slots);
    }
  }

  /** The number of edges whose ends were both there at a revision. */
  countAt(revision, { born, died }) {
    const { pairs, length } = this;
    const isThere = (slot) => born[slot] <= revision && revision < died[slot];
    let count = 0;
    for (let i = 0; i < length; i++) count += isThere(pairs[2 * i]) && isThere(pairs[2 * i + 1]) ? 1 : 0;
    return count;
  }

  /** Joins the edges whose other end has come meanwhile. */
  settle(slots) {
    const waiting = this.#waiting;
    this.#waiting = [];
    for (const [slot, low, high] of waiting) this.#join(slot, low, high, slots);
  }

  /** Renames the slots after some were given up, for which `moved` has −1. */
  rename(moved) {
    this.#keep((a, b) => moved[a] >= 0 && moved[b] >= 0);
    for (let i = 0; i < 2 * this.length; i++) this.pairs[i] = moved[this.pairs[i]];
    this.#waiting = this.#waiting.filter(([slot]) => moved[slot] >= 0).map(([slot, ...id]) => [moved[slot], ...id]);
    this.#told = new Uint8Array(moved.length);
    for (let i = 0; i < this.length; i++) this.#told[this.pairs[2 * i]] = 1;
  }

  #join(slot, low, high, slots) {
    const other = slots.get(low, high);
    if (this.length >= MAX_EDGES) return;
    if (other < 0) {
      if (this.#waiting.length < MAX_EDGES) this.#waiting.push([slot, low, high]);
      return;
    }
    if (2 * this.length === this.pairs.length) {
      const larger = new Uint32Array(Math.max(4096, 2 * this.pairs.length));
      larger.set(this.pairs);
      this.pairs = larger;
    }
    this.pairs[2 * this.length] = slot;
    this.pairs[2 * this.length + 1] = other;
    this.length += 1;
  }

  #mark(slot) {
    if (slot >= this.#told.length) {
      const larger = new Uint8Array(Math.max(slot + 1, 4096, 2 * this.#told.length));
      larger.set(this.#told);
      this.#told = larger;
    }
    this.#told[slot] = 1;
  }

  #keep(isKept) {
    const { pairs } = this;
    let to = 0;
    for (let i = 0; i < this.length; i++) {
      if (!isKept(pairs[2 * i], pairs[2 * i + 1])) continue;
      pairs[2 * to] = pairs[2 * i];
      pairs[2 * to + 1] = pairs[2 * i + 1];
      to += 1;
    }
    this.length = to;
    this.generation += 1;
  }
}

/** The pairs [from, to) that can be drawn as a straight line: not those that cross the seam of an angle. */
export function drawable({ pairs }, from, to, { halves }, wraps) {
  const kept = new Uint32Array(2 * (to - from));
  let length = 0;
  for (let i = from; i < to; i++) {
    const [a, b] = [pairs[2 * i], pairs[2 * i + 1]];
    const isAcross = wraps.some((isWrapped, axis) => isWrapped && Math.abs(halves[8 * a + axis] - halves[8 * b + axis]) > 32768);
    if (isAcross) continue;
    kept[length] = a;
    kept[length + 1] = b;
    length += 2;
  }
  return kept.subarray(0, length);
}

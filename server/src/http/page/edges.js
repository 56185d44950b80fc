// The edges of a cloud: pairs of slots. A server tells them for indices whose payloads are the ids of neighbours.

// More edges hide the picture, and each takes 8 bytes here and in the graphics processor.
const MAX_EDGES = 3_000_000;
const NONE = -1;

/** Edges that grow. A point tells all of its edges at once, and does so again when their number changes. */
export class Edges {
  /** Pairs of slots, of which the first `length` pairs count. An edge that is gone has twice the same slot. */
  pairs = new Uint32Array(0);
  length = 0;
  /** Counts how often pairs changed: what was built from them has to be built again. */
  generation = 0;
  // The edges that a slot told are a list: the first of a slot, and the next of an edge.
  #first = new Int32Array(0);
  #next = new Int32Array(0);
  // Edges whose other end has not come yet: the slot, and the id of that end.
  #waiting = [];

  /** Takes an `edges` frame: the ids of one end, then those of the other. `slots` finds the slot of an id. */
  append({ count }, body, slots) {
    const ids = new Uint32Array(body, 0, 4 * count);
    // The edges of a point follow each other.
    for (let from = 0, to = 0; from < count; from = to) {
      const [low, high] = [ids[2 * from], ids[2 * from + 1]];
      const slot = slots.get(low, high);
      const others = [];
      for (; to < count && ids[2 * to] === low && ids[2 * to + 1] === high; to++) {
        others.push([ids[2 * (count + to)], ids[2 * (count + to) + 1]]);
      }
      if (slot < 0) continue;
      this.#dropOthers(slot, others, slots);
      for (const [otherLow, otherHigh] of others) this.#join(slot, otherLow, otherHigh, slots);
    }
  }

  /** Joins the edges whose other end has come meanwhile. */
  settle(slots) {
    const waiting = this.#waiting;
    this.#waiting = [];
    for (const [slot, low, high] of waiting) this.#join(slot, low, high, slots);
  }

  /** True if further edges are left out. */
  get isFull() {
    return this.length >= MAX_EDGES;
  }

  /** The number of edges whose ends were both there at a revision. */
  countAt(revision, { born, died }) {
    const { pairs, length } = this;
    const isThere = (slot) => born[slot] <= revision && revision < died[slot];
    let count = 0;
    for (let i = 0; i < length; i++) {
      const [a, b] = [pairs[2 * i], pairs[2 * i + 1]];
      count += a !== b && isThere(a) && isThere(b) ? 1 : 0;
    }
    return count;
  }

  /** Renames the slots after some were given up, for which `moved` has −1. */
  rename(moved) {
    const { pairs, length } = this;
    this.#waiting = this.#waiting.filter(([slot]) => moved[slot] >= 0).map(([slot, ...id]) => [moved[slot], ...id]);
    this.#first = new Int32Array(0);
    this.length = 0;
    this.generation += 1;
    for (let i = 0; i < length; i++) {
      const [a, b] = [moved[pairs[2 * i]], moved[pairs[2 * i + 1]]];
      if (a >= 0 && b >= 0 && a !== b) this.#add(a, b);
    }
  }

  // Takes away the edges that a point told earlier and does not tell now.
  #dropOthers(slot, others, slots) {
    if (slot >= this.#first.length || this.#first[slot] === NONE) return;
    const told = new Set(others.map(([low, high]) => slots.get(low, high)));
    for (let edge = this.#first[slot]; edge !== NONE; edge = this.#next[edge]) {
      const other = this.pairs[2 * edge + 1];
      if (told.has(other) || other === slot) continue;
      this.pairs[2 * edge + 1] = slot;
      this.generation += 1;
    }
  }

  #join(slot, low, high, slots) {
    const other = slots.get(low, high);
    if (other < 0) {
      if (this.#waiting.length < MAX_EDGES) this.#waiting.push([slot, low, high]);
      return;
    }
    if (other === slot || this.length >= MAX_EDGES || this.#has(slot, other)) return;
    this.#add(slot, other);
  }

  #has(slot, other) {
    if (slot >= this.#first.length) return false;
    for (let edge = this.#first[slot]; edge !== NONE; edge = this.#next[edge]) {
      if (this.pairs[2 * edge + 1] === other) return true;
    }
    return false;
  }

  #add(slot, other) {
    const edge = this.length;
    this.pairs = grown(this.pairs, 2 * edge + 2, 0);
    this.#next = grown(this.#next, edge + 1, NONE);
    this.#first = grown(this.#first, slot + 1, NONE);
    this.pairs[2 * edge] = slot;
    this.pairs[2 * edge + 1] = other;
    this.#next[edge] = this.#first[slot];
    this.#first[slot] = edge;
    this.length += 1;
  }
}

function grown(column, least, filler) {
  if (least <= column.length) return column;
  const larger = new column.constructor(Math.max(least, 4096, 2 * column.length)).fill(filler);
  larger.set(column);
  return larger;
}

/** The pairs [from, to) that can be drawn as a straight line: not those that cross the seam of an angle. */
export function drawable({ pairs }, from, to, { halves }, wraps) {
  const kept = new Uint32Array(2 * (to - from));
  let length = 0;
  for (let i = from; i < to; i++) {
    const [a, b] = [pairs[2 * i], pairs[2 * i + 1]];
    const isAcross = wraps.some((isWrapped, axis) => isWrapped && Math.abs(halves[8 * a + axis] - halves[8 * b + axis]) > 32768);
    if (a === b || isAcross) continue;
    kept[length] = a;
    kept[length + 1] = b;
    length += 2;
  }
  return kept.subarray(0, length);
}

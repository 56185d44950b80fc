// The edges of a cloud: pairs of slots. A server tells them for indices that declare how their payloads hold edges.

import { grown } from "./columns.js";
import { Waiting } from "./waiting.js";

// More edges hide the picture, and each takes 8 bytes in the graphics processor.
const MAX_EDGES = 3_000_000;
// Edges that are gone are taken out once they are half of all, and not before there are this many.
const MIN_GONE = 4096;
const NONE = -1;

/**
 * Edges that grow. A point lists all of its edges at once, and again whenever its payload may have changed. An edge that both
 * of its ends list is one edge, and stays until neither lists it.
 */
export class Edges {
  /** Pairs of slots, of which the first `length` pairs count. An edge that is gone has twice the same slot. */
  pairs = new Uint32Array(0);
  length = 0;
  /** Counts how often pairs changed: what was built from them has to be built again. */
  generation = 0;
  // The ends that list an edge: 1 for the first, 2 for the second, 3 for both.
  #listed = new Uint8Array(0);
  // The edges at a slot are a list of ends; end 2e is the first one of edge e, and 2e + 1 the second.
  #first = new Int32Array(0);
  #next = new Int32Array(0);
  #gone = 0;
  #waiting = new Waiting(MAX_EDGES);
  // The slots that came again, and whose edges have not come yet.
  #untold = new Set();

  constructor(share) {
    this.share = share;
  }

  /** The number of edges. */
  get count() {
    return this.length - this.#gone;
  }

  /** True if further edges are left out. */
  get isFull() {
    return this.count >= MAX_EDGES;
  }

  /** Takes an `edges` frame: the ids of one end, then those of the other. `slots` finds the slot of an id. */
  append({ row_count: rows }, body, slots) {
    const ids = new Uint32Array(body, 0, 4 * rows);
    // The edges of a point follow each other.
    for (let from = 0, to = 0; from < rows; from = to) {
      const [low, high] = [ids[2 * from], ids[2 * from + 1]];
      while (to < rows && ids[2 * to] === low && ids[2 * to + 1] === high) to += 1;
      const slot = slots.get(low, high);
      if (slot >= 0) this.#list(slot, ids.subarray(2 * (rows + from), 2 * (rows + to)), slots);
    }
  }

  /** The payload of a slot may have changed: its edges follow, or it has none. */
  expect(slot) {
    if (this.#hasEdges(slot) || this.#waiting.has(slot)) this.#untold.add(slot);
  }

  /** Drops the edges of the points whose payloads came without any. */
  dropUntold() {
    if (this.#untold.size === 0) return;
    for (const slot of this.#untold) this.#list(slot, [], null);
    this.#untold.clear();
  }

  /** A point came with `slot`; one with the same id had the slot `before`, or −1. Edges that others list reach it now. */
  arrive(low, high, slot, before) {
    if (before >= 0) this.#move(before, slot);
    this.#waiting.take(low, high, (other) => this.#join(other, slot));
  }

  /** The number of edges whose ends were both there at a revision. */
  countAt(revision, { born, died, newest }) {
    const { pairs, length } = this;
    const at = Math.min(revision, newest);
    const isThere = (slot) => born[slot] <= at && at < died[slot];
    let count = 0;
    for (let i = 0; i < length; i++) {
      const [a, b] = [pairs[2 * i], pairs[2 * i + 1]];
      count += a !== b && isThere(a) && isThere(b) ? 1 : 0;
    }
    return count;
  }

  /** Renames the slots, of which some are given up: `moved` has −1 for them. `ids` are those of the slots so far. */
  rename(moved, ids) {
    this.#waiting = this.#waiting.renamed(moved, this.share);
    this.#untold = new Set([...this.#untold].map((slot) => moved[slot]).filter((slot) => slot >= 0));
    // A point that is listed, and is given up, may come again.
    for (let end = 0; end < 2 * this.length; end++) {
      const [slot, other] = [this.pairs[end], this.pairs[end ^ 1]];
      const isListed = slot !== other && this.#listed[end >> 1] & bitOf(end);
      if (isListed && moved[slot] >= 0 && moved[other] < 0) this.#wait(moved[slot], ids[2 * other], ids[2 * other + 1]);
    }
    this.#rebuild((slot) => moved[slot]);
  }

  // Takes the edges that a point lists now: adds the new ones, and takes away those that it does not list any more.
  #list(slot, ids, slots) {
    this.#untold.delete(slot);
    this.#waiting.forget(slot);
    const old = new Map();
    if (this.#hasEdges(slot)) for (const end of this.#endsAt(slot)) old.set(this.pairs[end ^ 1], end);
    const listed = new Set();
    for (let i = 0; i < ids.length; i += 2) {
      const other = slots.get(ids[i], ids[i + 1]);
      if (other === slot || listed.has(other)) continue;
      if (other < 0) {
        this.#wait(slot, ids[i], ids[i + 1]);
        continue;
      }
      listed.add(other);
      const end = old.get(other);
      if (end === undefined) this.#add(slot, other, 1);
      else this.#listed[end >> 1] |= bitOf(end);
    }
    for (const [other, end] of old) if (!listed.has(other)) this.#unlist(end);
    if (this.#gone > MIN_GONE && 2 * this.#gone > this.length) this.#rebuild((same) => same);
  }

  // Keeps an edge for when its other end comes. A point outside the sample never does.
  #wait(slot, low, high) {
    if (this.share.has(low, high)) this.#waiting.add(slot, low, high);
  }

  // A point that was replaced, or removed and stored again, lists nothing any more. The edges that other points list reach the new one.
  #move(before, slot) {
    this.#untold.delete(before);
    this.#waiting.forget(before);
    if (!this.#hasEdges(before)) return;
    const ends = [...this.#endsAt(before)];
    this.#first[before] = NONE;
    for (const end of ends) {
      this.#unlist(end);
      if (this.pairs[end] === this.pairs[end ^ 1]) continue;
      this.pairs[end] = slot;
      this.#link(slot, end);
    }
    this.generation += 1;
  }

  // Joins the edge that `slot` lists to a point that has come.
  #join(slot, other) {
    if (slot === other) return;
    if (this.#hasEdges(other)) {
      for (const end of this.#endsAt(other)) {
        if (this.pairs[end ^ 1] !== slot) continue;
        this.#listed[end >> 1] |= bitOf(end ^ 1);
        return;
      }
    }
    this.#add(slot, other, 1);
  }

  #hasEdges(slot) {
    return slot < this.#first.length && this.#first[slot] !== NONE;
  }

  *#endsAt(slot) {
    for (let end = this.#first[slot]; end !== NONE; end = this.#next[end]) {
      if (this.pairs[end] === slot && this.pairs[end ^ 1] !== slot) yield end;
    }
  }

  #unlist(end) {
    const edge = end >> 1;
    const isGone = this.#listed[edge] === 0;
    this.#listed[edge] &= ~bitOf(end);
    if (isGone || this.#listed[edge] !== 0) return;
    this.pairs[2 * edge + 1] = this.pairs[2 * edge];
    this.#gone += 1;
    this.generation += 1;
  }

  #add(slot, other, listed) {
    if (this.isFull) return;
    const edge = this.length;
    this.pairs = grown(this.pairs, 2 * edge + 2);
    this.#next = grown(this.#next, 2 * edge + 2, NONE);
    this.#listed = grown(this.#listed, edge + 1);
    this.#first = grown(this.#first, Math.max(slot, other) + 1, NONE);
    this.pairs[2 * edge] = slot;
    this.pairs[2 * edge + 1] = other;
    this.#listed[edge] = listed;
    this.#link(slot, 2 * edge);
    this.#link(other, 2 * edge + 1);
    this.length += 1;
  }

  #link(slot, end) {
    this.#first = grown(this.#first, slot + 1, NONE);
    this.#next[end] = this.#first[slot];
    this.#first[slot] = end;
  }

  // Builds all lists again, without the edges that are gone.
  #rebuild(nameOf) {
    const { pairs, length } = this;
    const listed = this.#listed.slice(0, length);
    this.#first.fill(NONE);
    this.length = 0;
    this.#gone = 0;
    this.generation += 1;
    for (let edge = 0; edge < length; edge++) {
      const [a, b] = [pairs[2 * edge], pairs[2 * edge + 1]];
      if (a !== b && nameOf(a) >= 0 && nameOf(b) >= 0) this.#add(nameOf(a), nameOf(b), listed[edge]);
    }
  }
}

// The bit of an end in `listed`.
function bitOf(end) {
  return 1 << (end & 1);
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

// The edges whose other end has not come yet, by the id of that end.

import { grown } from "./columns.js";
import { IdMap } from "./id_map.js";

const END = -2;
// A slot of −1 marks an entry that is not in use.
const FREE = -1;

/** Edges that wait. An entry is a slot and the id that its point lists; the entries of one id are a list. */
export class Waiting {
  #heads = new IdMap();
  #ids = new Uint32Array(0);
  #slots = new Int32Array(0);
  #next = new Int32Array(0);
  // An entry counts if its round is that of its slot: so a slot gives up all of its entries at once.
  #rounds = new Uint32Array(0);
  #roundOf = new Uint32Array(0);
  #countOf = new Uint32Array(0);
  #length = 0;
  #free = END;

  constructor(most) {
    this.most = most;
  }

  /** Adds the edge from a slot to a point with this id. */
  add(slot, low, high) {
    const entry = this.#entry();
    if (entry < 0) return;
    this.#roundOf = grown(this.#roundOf, slot + 1);
    this.#countOf = grown(this.#countOf, slot + 1);
    const head = this.#heads.get(low, high);
    this.#ids[2 * entry] = low;
    this.#ids[2 * entry + 1] = high;
    this.#slots[entry] = slot;
    this.#rounds[entry] = this.#roundOf[slot];
    this.#next[entry] = head < 0 ? END : head;
    this.#countOf[slot] += 1;
    this.#heads.set(low, high, entry);
  }

  /** Takes the edges to this id out, and calls `found` with the slot of each. */
  take(low, high, found) {
    let entry = this.#heads.get(low, high);
    if (entry < 0) return;
    this.#heads.set(low, high, END);
    while (entry >= 0) {
      const next = this.#next[entry];
      const slot = this.#slots[entry];
      if (this.#counts(entry)) {
        this.#countOf[slot] -= 1;
        found(slot);
      }
      this.#slots[entry] = FREE;
      this.#next[entry] = this.#free;
      this.#free = entry;
      entry = next;
    }
  }

  /** True if an edge of a slot waits. */
  has(slot) {
    return slot < this.#countOf.length && this.#countOf[slot] > 0;
  }

  /** Gives up all edges of a slot. */
  forget(slot) {
    if (!this.has(slot)) return;
    this.#roundOf[slot] += 1;
    this.#countOf[slot] = 0;
  }

  /** The waiting edges that are left after slots were renamed; `moved` has −1 for those that were given up. */
  renamed(moved, share) {
    const kept = new Waiting(this.most);
    for (let entry = 0; entry < this.#length; entry++) {
      const slot = this.#slots[entry];
      if (slot === FREE || !this.#counts(entry) || moved[slot] < 0) continue;
      const [low, high] = [this.#ids[2 * entry], this.#ids[2 * entry + 1]];
      if (share.has(low, high)) kept.add(moved[slot], low, high);
    }
    return kept;
  }

  #counts(entry) {
    return this.#rounds[entry] === this.#roundOf[this.#slots[entry]];
  }

  #entry() {
    if (this.#free >= 0) {
      const entry = this.#free;
      this.#free = this.#next[entry];
      return entry;
    }
    if (this.#length >= this.most) return FREE;
    const entry = this.#length++;
    this.#ids = grown(this.#ids, 2 * this.#length);
    this.#slots = grown(this.#slots, this.#length, FREE);
    this.#next = grown(this.#next, this.#length);
    this.#rounds = grown(this.#rounds, this.#length);
    return entry;
  }
}

// A hash table from 64-bit ids to slots. A Map of BigInts takes ten times the memory and the time at a million points.

const FREE = -1;

/** The newest slot of each id. Ids are never taken out, because a slot stays after its point was removed. */
export class IdMap {
  #low = new Uint32Array(1 << 12);
  #high = new Uint32Array(1 << 12);
  #slots = new Int32Array(1 << 12).fill(FREE);
  #size = 0;

  /** The slot of an id, or −1. */
  get(low, high) {
    return this.#slots[this.#find(low, high)];
  }

  /** Sets the slot of an id, and returns the one before, or −1. */
  set(low, high, slot) {
    if (2 * (this.#size + 1) > this.#slots.length) this.#grow();
    const at = this.#find(low, high);
    const before = this.#slots[at];
    if (before === FREE) this.#size += 1;
    this.#low[at] = low;
    this.#high[at] = high;
    this.#slots[at] = slot;
    return before;
  }

  #find(low, high) {
    const mask = this.#slots.length - 1;
    const hash = Math.imul(low ^ Math.imul(high, 0x85ebca6b), 0x9e3779b1);
    let at = (hash ^ (hash >>> 15)) & mask;
    while (this.#slots[at] !== FREE && (this.#low[at] !== low || this.#high[at] !== high)) at = (at + 1) & mask;
    return at;
  }

  #grow() {
    const [low, high, slots] = [this.#low, this.#high, this.#slots];
    this.#low = new Uint32Array(2 * low.length);
    this.#high = new Uint32Array(2 * high.length);
    this.#slots = new Int32Array(2 * slots.length).fill(FREE);
    for (let i = 0; i < slots.length; i++) {
      if (slots[i] === FREE) continue;
      const at = this.#find(low[i], high[i]);
      this.#low[at] = low[i];
      this.#high[at] = high[i];
      this.#slots[at] = slots[i];
    }
  }
}

// Points of the past without a known place: their states were stored before the log's window, and they were removed or
// replaced within it. Only the revision of that removal is known.

/** The lost points of an index, in the order of their deaths. */
export class Lost {
  // The revisions of the deaths, and the ids as pairs of 32 bits.
  #deaths = [];
  #ids = [];

  /** Adds a point that was there before the revision `death`, which is none before that of the last point added. */
  add(low, high, death) {
    this.#deaths.push(death);
    this.#ids.push(low, high);
  }

  /** The number of points that died after a revision: those that were there. */
  after(revision) {
    let [from, to] = [0, this.#deaths.length];
    while (from < to) {
      const middle = (from + to) >> 1;
      if (this.#deaths[middle] > revision) to = middle;
      else from = middle + 1;
    }
    return this.#deaths.length - from;
  }

  /** Those that died after `from`, and at `to` at the latest. */
  within(from, to) {
    return this.#filtered((i) => this.#deaths[i] > from && this.#deaths[i] <= to);
  }

  /** Those of a share of the points. */
  of(share) {
    return this.#filtered((i) => share.has(this.#ids[2 * i], this.#ids[2 * i + 1]));
  }

  /** These and then those of `later`. */
  and(later) {
    const all = this.#filtered(() => true);
    later.#deaths.forEach((death, i) => all.add(later.#ids[2 * i], later.#ids[2 * i + 1], death));
    return all;
  }

  #filtered(isKept) {
    const kept = new Lost();
    this.#deaths.forEach((death, i) => isKept(i) && kept.add(this.#ids[2 * i], this.#ids[2 * i + 1], death));
    return kept;
  }
}

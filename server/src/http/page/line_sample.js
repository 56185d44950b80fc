// The points of a cloud that are drawn as lines: an even sample, because more lines than this hide each other.

import { Share } from "./share.js";

/** A sample of at most `most` slots, which follows its cloud. */
export class LineSample {
  slots = [];
  #share = new Share(1);
  #scanned = 0;
  #generation = -1;

  constructor(most) {
    this.most = most;
  }

  /** Brings the sample up to date with the cloud. */
  update(cloud) {
    if (this.#generation !== cloud.generation) {
      this.slots = [];
      this.#scanned = 0;
      this.#share = cloud.share;
      this.#generation = cloud.generation;
    }
    const isIn = (slot) => this.#share.has(cloud.ids[2 * slot], cloud.ids[2 * slot + 1]);
    for (; this.#scanned < cloud.length; this.#scanned++) {
      if (!isIn(this.#scanned)) continue;
      this.slots.push(this.#scanned);
      if (this.slots.length <= this.most) continue;
      // The sample is a share of the ids, as that of the server: so a half of it is as even.
      this.#share = new Share(this.#share.fraction / 2);
      this.slots = this.slots.filter(isIn);
    }
  }

  /** The number of lines that are there at a revision. */
  countAt(revision, { born, died, newest }) {
    const at = Math.min(revision, newest);
    return this.slots.reduce((sum, slot) => sum + (born[slot] <= at && at < died[slot] ? 1 : 0), 0);
  }
}

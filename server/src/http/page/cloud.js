// The points of one index as the stream told them: columns that grow, with the revisions of each point's life.

import { Edges } from "./edges.js";
import { pointColumns, removedIds } from "./frames.js";
import { IdMap } from "./id_map.js";

/** The revision of death of a point that is alive. */
export const ALIVE = 0xffffffff;
// Removed points stay for the slider. Above this number beyond the living ones, the page forgets all of them.
const MAX_REMOVED = 1_000_000;

/** The points of an index. A slot is a point's place in all columns; a removed or replaced point keeps its slot. */
export class Cloud {
  /** Forgets everything, at the head of a `begin` frame. */
  begin({ uid, revision, coordinates, points, share }) {
    this.uid = uid;
    this.coordinates = coordinates;
    this.total = Number(points);
    this.share = Number(share);
    this.newest = Number(revision);
    this.oldest = 0;
    this.length = 0;
    this.alive = 0;
    this.ids = new Uint32Array(0);
    this.tags = new Uint32Array(0);
    this.rows = new Float32Array(0);
    this.born = new Uint32Array(0);
    this.died = new Uint32Array(0);
    this.low = new Float64Array(coordinates).fill(Infinity);
    this.high = new Float64Array(coordinates).fill(-Infinity);
    this.slots = new IdMap();
    this.edges = new Edges();
    this.changed = { from: 0, to: 0 };
    // Counts how often slots moved: a picture then has to encode all of them again.
    this.generation = (this.generation ?? 0) + 1;
  }

  /** Takes a `points` frame. A point whose id is there already takes the place of the old one. */
  append(head, body) {
    const { count, ids, revisions, tags, coordinates } = pointColumns(head, body, this.coordinates);
    const from = this.length;
    this.#reserve(from + count);
    this.ids.set(ids, 2 * from);
    this.tags.set(tags, 2 * from);
    this.rows.set(coordinates, this.coordinates * from);
    this.died.fill(ALIVE, from, from + count);
    let first = from;
    for (let i = 0; i < count; i++) {
      const slot = from + i;
      this.born[slot] = revision32(revisions, i);
      this.newest = Math.max(this.newest, this.born[slot]);
      const before = this.slots.get(ids[2 * i], ids[2 * i + 1]);
      const isAlive = before >= 0 && this.died[before] === ALIVE;
      if (isAlive && this.born[before] === this.born[slot]) {
        // Only the tag or the payload changed: the point keeps its slot, and the new one is never shown.
        this.tags.set([tags[2 * i], tags[2 * i + 1]], 2 * before);
        this.born[slot] = ALIVE;
        this.died[slot] = 0;
        this.alive -= 1;
        first = Math.min(first, before);
        continue;
      }
      this.slots.set(ids[2 * i], ids[2 * i + 1], slot);
      if (isAlive) {
        this.died[before] = this.born[slot];
        this.alive -= 1;
        first = Math.min(first, before);
      }
    }
    this.#widen(coordinates);
    this.length += count;
    this.alive += count;
    this.#touch(first, this.length);
  }

  /** Takes a `removed` frame. Ids that the sample leaves out are unknown here, and that is no fault. */
  remove(head, body) {
    const ids = removedIds(head, body);
    const revision = Number(head.revision);
    for (let i = 0; i < head.count; i++) {
      const slot = this.slots.get(ids[2 * i], ids[2 * i + 1]);
      if (slot < 0 || this.died[slot] !== ALIVE) continue;
      this.died[slot] = revision;
      this.alive -= 1;
      this.#touch(slot, slot + 1);
    }
    this.reach(revision);
    if (this.length - this.alive > this.alive + MAX_REMOVED) this.#forgetRemoved();
  }

  /** Everything up to this revision has come. */
  reach(revision) {
    this.newest = Math.max(this.newest, Number(revision));
  }

  /** The number of points that were there at a revision. */
  countAt(revision) {
    if (revision >= this.newest) return this.alive;
    const { born, died, length } = this;
    let count = 0;
    for (let slot = 0; slot < length; slot++) count += born[slot] <= revision && revision < died[slot] ? 1 : 0;
    return count;
  }

  /** The id of a slot, as text: it may exceed what a number of JavaScript holds. */
  idOf(slot) {
    return wide(this.ids, slot).toString();
  }

  tagOf(slot) {
    return wide(this.tags, slot);
  }

  /** The coordinates of a slot. */
  stateOf(slot) {
    return this.rows.slice(slot * this.coordinates, (slot + 1) * this.coordinates);
  }

  #touch(from, to) {
    const { changed } = this;
    this.changed = changed.from < changed.to ? { from: Math.min(changed.from, from), to: Math.max(changed.to, to) } : { from, to };
  }

  #widen(coordinates) {
    const { low, high } = this;
    const width = this.coordinates;
    for (let i = 0; i < coordinates.length; i += width) {
      for (let c = 0; c < width; c++) {
        const number = coordinates[i + c];
        if (number < low[c]) low[c] = number;
        if (number > high[c]) high[c] = number;
      }
    }
  }

  #reserve(slots) {
    const capacity = this.born.length;
    if (slots <= capacity) return;
    const room = Math.max(slots, 2 * capacity, 4096);
    const grown = (column, width) => {
      const larger = new column.constructor(width * room);
      larger.set(column);
      return larger;
    };
    this.ids = grown(this.ids, 2);
    this.tags = grown(this.tags, 2);
    this.rows = grown(this.rows, this.coordinates);
    this.born = grown(this.born, 1);
    this.died = grown(this.died, 1);
  }

  #forgetRemoved() {
    const { coordinates, died } = this;
    this.slots = new IdMap();
    const moved = new Int32Array(this.length).fill(-1);
    let to = 0;
    for (let from = 0; from < this.length; from++) {
      if (died[from] !== ALIVE) continue;
      this.ids.copyWithin(2 * to, 2 * from, 2 * from + 2);
      this.tags.copyWithin(2 * to, 2 * from, 2 * from + 2);
      this.rows.copyWithin(coordinates * to, coordinates * from, coordinates * (from + 1));
      this.born[to] = this.born[from];
      this.died[to] = ALIVE;
      moved[from] = to;
      this.slots.set(this.ids[2 * to], this.ids[2 * to + 1], to);
      to += 1;
    }
    this.edges.rename(moved);
    this.length = to;
    this.oldest = this.newest;
    this.changed = { from: 0, to };
    this.generation += 1;
  }
}

function wide(pairs, at) {
  return (BigInt(pairs[2 * at + 1]) << 32n) | BigInt(pairs[2 * at]);
}

/** A revision in the 32 bits that a vertex has for it. An index would need years of writes to exceed them. */
function revision32(pairs, at) {
  return pairs[2 * at + 1] === 0 ? Math.min(pairs[2 * at], ALIVE - 1) : ALIVE - 1;
}

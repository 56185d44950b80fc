// The points of one index as the stream told them: columns that grow, with the revisions of each point's life.

import { grown } from "./columns.js";
import { Edges } from "./edges.js";
import { idsOf, pointColumns } from "./frames.js";
import { IdMap } from "./id_map.js";
import { Lost } from "./lost.js";
import { Share } from "./share.js";

/** The revision of death of a point that is alive. */
export const ALIVE = 0xffffffff;
// Removed and replaced points stay for the slider. Above this number beyond the living ones, the page forgets the older half.
const MAX_DEAD = 1_000_000;

/** The points of an index. A slot is a point's place in all columns; a removed or replaced point keeps its slot. */
export class Cloud {
  /** Forgets everything, at the head of a `begin` frame. */
  begin({ revision, oldest_revision, coordinate_count, point_count, share }) {
    this.uid = revision.uid;
    this.coordinateCount = coordinate_count;
    this.total = Number(point_count);
    this.share = new Share(Number(share));
    this.newest = Number(revision.number);
    /** The oldest revision after which the server still tells every mutation. */
    this.windowStart = Number(oldest_revision.number);
    /** From this revision on, the cloud has every point that was there. */
    this.knownFrom = this.newest;
    this.length = 0;
    this.alive = 0;
    this.ids = new Uint32Array(0);
    this.tags = new Uint32Array(0);
    this.rows = new Float32Array(0);
    this.born = new Uint32Array(0);
    this.died = new Uint32Array(0);
    this.low = new Float64Array(coordinate_count).fill(Infinity);
    this.high = new Float64Array(coordinate_count).fill(-Infinity);
    this.slots = new IdMap();
    this.edges = new Edges(this.share);
    /** The points that are known to have been there, but not where. */
    this.lost = new Lost();
    this.changed = { from: 0, to: 0 };
    // Counts how often slots moved: a picture then has to encode all of them again.
    this.generation = (this.generation ?? 0) + 1;
  }

  /** Takes a `points` frame. A point whose id is there already takes the place of the old one. */
  append(head, body) {
    const { ids, revisions, tags, coordinates } = pointColumns(head, body, this.coordinateCount);
    this.#reserve(this.length + head.row_count);
    this.edges.dropUntold();
    let first = this.length;
    for (let i = 0; i < head.row_count; i++) {
      const born = revision32(revisions, i);
      const before = this.slots.get(ids[2 * i], ids[2 * i + 1]);
      const isAlive = before >= 0 && this.died[before] === ALIVE;
      if (isAlive) first = Math.min(first, before);
      if (isAlive && this.born[before] === born) {
        // Only the tag or the payload changed: the point keeps its slot.
        this.tags.set([tags[2 * i], tags[2 * i + 1]], 2 * before);
        this.edges.expect(before);
        continue;
      }
      if (isAlive) {
        this.died[before] = born;
        this.alive -= 1;
      }
      const slot = this.#add(ids, tags, coordinates, i, born, ALIVE);
      this.slots.set(ids[2 * i], ids[2 * i + 1], slot);
      this.edges.arrive(ids[2 * i], ids[2 * i + 1], slot, before);
      this.newest = Math.max(this.newest, born);
      this.alive += 1;
    }
    this.#touch(first, this.length);
    this.#forgetSome();
  }

  /** Takes a `removed` frame. Ids that the sample leaves out are unknown here, and that is no fault. */
  remove(head, body) {
    const ids = idsOf(head, body);
    const revision = Number(head.revision.number);
    this.edges.dropUntold();
    for (let i = 0; i < head.row_count; i++) {
      const slot = this.slots.get(ids[2 * i], ids[2 * i + 1]);
      if (slot < 0 || this.died[slot] !== ALIVE) continue;
      this.died[slot] = revision;
      this.alive -= 1;
      this.#touch(slot, slot + 1);
    }
    this.newest = Math.max(this.newest, revision);
    this.#forgetSome();
  }

  /** Everything up to this revision has come. */
  advanceTo({ number }) {
    this.edges.dropUntold();
    this.newest = Math.max(this.newest, Number(number));
  }

  /**
   * Adds the points of `past` that died before this cloud began: `past` has replayed the mutations from its own beginning to
   * that of this cloud, and `lost` has those of which it had no state.
   */
  adopt(past, lost) {
    const until = this.knownFrom;
    const from = this.length;
    for (let slot = 0; slot < past.length; slot++) {
      if (past.died[slot] > until) continue;
      this.#reserve(this.length + 1);
      this.#add(past.ids, past.tags, past.rows, slot, past.born[slot], past.died[slot]);
    }
    this.lost = lost.within(past.knownFrom, until).and(this.lost);
    this.knownFrom = Math.min(until, past.knownFrom);
    this.#touch(from, this.length);
    this.#forgetSome();
  }

  /** Keeps only the points of a smaller share. */
  thin(share) {
    this.share = share;
    this.edges.share = share;
    this.lost = this.lost.of(share);
    this.#compact((slot) => share.has(this.ids[2 * slot], this.ids[2 * slot + 1]));
  }

  /** The number of points that were there at a revision; without those that are not known, before `knownFrom`. */
  countAt(revision) {
    if (revision >= this.newest) return this.alive;
    const { born, died, length } = this;
    let count = this.lostAt(revision);
    for (let slot = 0; slot < length; slot++) count += born[slot] <= revision && revision < died[slot] ? 1 : 0;
    return count;
  }

  /** About how many points the whole index had at a revision, of which this may be a sample. */
  estimateAt(revision) {
    return this.countAt(revision) / this.share.fraction;
  }

  /** The number of points that were there at a revision and are not drawn, because nothing tells where. */
  lostAt(revision) {
    return revision < this.knownFrom ? 0 : this.lost.after(revision);
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
    return this.rows.slice(slot * this.coordinateCount, (slot + 1) * this.coordinateCount);
  }

  // Adds row `i` of other columns, and returns its slot.
  #add(ids, tags, rows, i, born, died) {
    const { coordinateCount, low, high } = this;
    const slot = this.length++;
    for (let half = 0; half < 2; half++) {
      this.ids[2 * slot + half] = ids[2 * i + half];
      this.tags[2 * slot + half] = tags[2 * i + half];
    }
    this.born[slot] = born;
    this.died[slot] = died;
    for (let c = 0; c < coordinateCount; c++) {
      const number = rows[coordinateCount * i + c];
      this.rows[coordinateCount * slot + c] = number;
      if (number < low[c]) low[c] = number;
      if (number > high[c]) high[c] = number;
    }
    return slot;
  }

  #touch(from, to) {
    const { changed } = this;
    if (from >= to) return;
    this.changed = changed.from < changed.to ? { from: Math.min(changed.from, from), to: Math.max(changed.to, to) } : { from, to };
  }

  #reserve(slots) {
    this.ids = grown(this.ids, 2 * slots);
    this.tags = grown(this.tags, 2 * slots);
    this.rows = grown(this.rows, this.coordinateCount * slots);
    this.born = grown(this.born, slots);
    this.died = grown(this.died, slots);
  }

  // Forgets the half of the dead points that died first, if there are many.
  #forgetSome() {
    const { died, length } = this;
    if (length - this.alive <= this.alive + MAX_DEAD) return;
    const deaths = died.slice(0, length).filter((revision) => revision !== ALIVE).sort();
    this.knownFrom = Math.max(this.knownFrom, deaths[deaths.length >> 1]);
    this.lost = this.lost.within(this.knownFrom, ALIVE);
    this.#compact((slot) => died[slot] > this.knownFrom);
  }

  #compact(isKept) {
    const { coordinateCount, ids, born, died } = this;
    const moved = new Int32Array(this.length).fill(-1);
    let kept = 0;
    for (let slot = 0; slot < this.length; slot++) if (isKept(slot)) moved[slot] = kept++;
    this.edges.rename(moved, ids);
    this.slots = new IdMap();
    this.alive = 0;
    for (let from = 0; from < this.length; from++) {
      const to = moved[from];
      if (to < 0) continue;
      ids.copyWithin(2 * to, 2 * from, 2 * from + 2);
      this.tags.copyWithin(2 * to, 2 * from, 2 * from + 2);
      this.rows.copyWithin(coordinateCount * to, coordinateCount * from, coordinateCount * (from + 1));
      born[to] = born[from];
      died[to] = died[from];
      if (died[to] === ALIVE) this.alive += 1;
      // The slot of an id is that of its last point: what is listed of a removed one reaches the next.
      const other = this.slots.get(ids[2 * to], ids[2 * to + 1]);
      if (other < 0 || died[other] < died[to]) this.slots.set(ids[2 * to], ids[2 * to + 1], to);
    }
    this.length = kept;
    this.changed = { from: 0, to: kept };
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

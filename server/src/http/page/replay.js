// The log's window before the page was opened: the points that were removed or replaced then.
//
// The server tells all mutations after a revision. They are replayed into a cloud of their own, from the start of the window
// to the revision at which the picture's cloud began; the points that died on the way are the past of that cloud.

import { ALIVE, Cloud } from "./cloud.js";
import { forget, report } from "./connection.js";
import { idsOf } from "./frames.js";
import { Lost } from "./lost.js";
import { followWhileVisible } from "./stream.js";

/** The past of the cloud of one index. */
export class Past {
  #stream = null;
  #replay = null;

  /** `changed` is called when more is known. */
  constructor(name, cloud, changed) {
    this.name = name;
    this.cloud = cloud;
    this.changed = changed;
  }

  /** Begins to load what the window has, unless that is known or on its way. */
  load() {
    const { cloud } = this;
    if (this.#stream || cloud.length === undefined || !(cloud.windowStart < cloud.knownFrom)) return;
    this.#replay = new Replay(cloud);
    this.#stream = followWhileVisible(() => this.#path(), {
      // After a lost connection or a pause the past is read again from its beginning.
      begin: () => (this.#replay = new Replay(cloud)),
      take: (head, body) => this.#take(head, body),
      state: (state, problem, code) => this.#replay && report(`past of ${this.name}`, state, problem, code),
    });
  }

  /** The part that is loaded, from 0 to 1; 1 if nothing is on its way. */
  get loaded() {
    if (!this.#stream) return 1;
    const { from, reached } = this.#replay;
    return Math.min((reached - from) / Math.max(this.cloud.knownFrom - from, 1), 0.99);
  }

  /** Gives up what is on its way. */
  stop() {
    this.#stream?.stop();
    this.#stream = this.#replay = null;
    forget(`past of ${this.name}`);
  }

  #path() {
    const { uid, share, windowStart } = this.cloud;
    return `api/v1/${encodeURIComponent(this.name)}/points?follow=true&after=${uid}:${windowStart}&share=${share.fraction}`;
  }

  #take(head, body) {
    if (head.kind === "begin") {
      // The window has moved on: `after` was before its start. So this tells all points, and where the window starts now.
      if (head.revision.uid !== this.cloud.uid) return this.stop();
      this.cloud.windowStart = Number(head.oldest_revision.number);
      return this.cloud.windowStart < this.cloud.knownFrom ? this.#stream.restart() : this.stop();
    }
    this.#replay.take(head, body);
    if (this.#replay.reached >= this.cloud.knownFrom) {
      this.cloud.adopt(this.#replay.cloud, this.#replay.lost);
      this.stop();
    }
    this.changed();
  }
}

/** The mutations after the start of a cloud's window, replayed. */
export class Replay {
  cloud = new Cloud();
  /** The points that were there at the start, as far as only their deaths were told. */
  lost = new Lost();

  constructor({ uid, coordinateCount, share, windowStart }) {
    const revision = { uid, number: windowStart };
    const counts = { coordinate_count: coordinateCount, point_count: 0 };
    this.cloud.begin({ revision, oldest_revision: revision, ...counts, share: share.fraction });
    this.from = this.reached = windowStart;
  }

  take(head, body) {
    if (head.kind === "points") this.cloud.append(head, body);
    if (head.kind === "replaced" || head.kind === "removed") this.#lose(head, body);
    if (head.kind === "removed") this.cloud.remove(head, body);
    if (head.kind === "at") this.reached = Number(head.revision.number);
  }

  // A point that died, and was not stored since the start, was there already.
  #lose(head, body) {
    const { slots, died } = this.cloud;
    const ids = idsOf(head, body);
    for (let i = 0; i < head.row_count; i++) {
      const [low, high] = [ids[2 * i], ids[2 * i + 1]];
      const slot = slots.get(low, high);
      if (slot < 0 || died[slot] !== ALIVE) this.lost.add(low, high, Number(head.revision.number));
    }
  }
}

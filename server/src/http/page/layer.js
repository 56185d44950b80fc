// One index in the picture: its stream, its points and its colour.

import { Refusal, call } from "./api.js";
import { Cloud } from "./cloud.js";
import { forget, report } from "./connection.js";
import { FrameReader } from "./frames.js";
import { parseSpace } from "./space.js";
import { follow } from "./stream.js";
import { Vertices } from "./vertices.js";

// A telephone has less memory, and a smaller screen shows fewer points anyway.
const MAX_POINTS = matchMedia("(max-width: 560px)").matches ? 250_000 : 1_000_000;

/** An index whose points are followed from the construction to `close`. */
export class Layer {
  cloud = new Cloud();
  vertices = new Vertices();
  /** The generation of the cloud that is encoded in the vertices. */
  generation = -1;
  /** The space; undefined until the server has told it. */
  space = undefined;
  /** True once everything up to some revision has come. */
  isComplete = false;

  /** `number` chooses the colour. `changed` is called when points came, and `spaceKnown` when the space is known. */
  constructor(name, number, { changed, spaceKnown }) {
    this.name = name;
    this.number = number;
    this.changed = changed;
    this.spaceKnown = spaceKnown;
    let reader;
    this.stream = follow(() => this.#path(), {
      begin: () => (reader = new FrameReader((head, body) => this.#take(head, body))),
      receive: (bytes) => reader.push(bytes),
      state: (state, problem) => this.#report(state, problem),
    });
  }

  close() {
    this.isClosed = true;
    this.stream.stop();
    forget(`points of ${this.name}`);
  }

  // After a lost connection, only what came after the last whole revision is asked for: so the slider keeps what it knows
  // of removed points. A sample cannot be continued so, because the server takes the rest for a stream of all points.
  #path() {
    const path = `api/v1/${encodeURIComponent(this.name)}/points?max=${MAX_POINTS}&follow=true&edges=true`;
    const canContinue = this.reached !== undefined && this.cloud.share >= 1;
    // A uid has only letters that need no encoding.
    return canContinue ? `${path}&after=${this.cloud.uid}:${this.reached}` : path;
  }

  #report(state, problem) {
    if (this.isClosed) return;
    // What the server refused may be the revision: the next request asks for everything.
    if (state === "refused") this.reached = undefined;
    report(`points of ${this.name}`, state, problem);
  }

  #take(head, body) {
    const { cloud } = this;
    switch (head.kind) {
      case "begin":
        cloud.begin(head);
        this.isComplete = false;
        this.reached = undefined;
        this.#askForSpace(head);
        break;
      case "points":
        cloud.append(head, body);
        break;
      case "edges":
        cloud.edges.append(head, body, cloud.slots);
        break;
      case "removed":
        cloud.remove(head, body);
        break;
      case "at":
        cloud.reach(head.revision);
        cloud.edges.settle(cloud.slots);
        this.reached = head.revision;
        this.isComplete = true;
        break;
      case "reset":
        // A new begin follows, and until then the old picture stays.
        this.reached = undefined;
        break;
      case "failed":
        throw new Refusal(0, head.status.code ?? 0, head.status.message, head.status.details ?? []);
    }
    this.changed();
  }

  // The stream does not tell the space, and an index of the same name may have another one after a `begin`.
  async #askForSpace({ uid, coordinates }) {
    if (this.uidOfSpace === uid) return;
    try {
      const { index } = await call(this.name, "info", {});
      if (this.isClosed || this.cloud.uid !== uid) return;
      this.uidOfSpace = uid;
      this.space = parseSpace(index.space_text, coordinates);
      this.spaceKnown(this);
    } catch (error) {
      if (!this.isClosed) report(`points of ${this.name}`, "refused", error.message);
    }
  }
}

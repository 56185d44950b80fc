// One index in the picture: its stream, its points and its colour.

import { Refusal, call } from "./api.js";
import { Cloud } from "./cloud.js";
import { forget, report } from "./connection.js";
import { Past } from "./replay.js";
import { Pauses } from "./pauses.js";
import { Share } from "./share.js";
import { parseSpace } from "./space.js";
import { followWhileVisible } from "./stream.js";
import { Vertices } from "./vertices.js";

// A telephone has less memory, and a smaller screen shows fewer points anyway. `?max=N` before the `#` of the address is another
// number.
const USUAL_POINTS = matchMedia("(max-width: 560px)").matches ? 250_000 : 1_000_000;
const MAX_POINTS = Math.max(1, Math.floor(Number(new URLSearchParams(location.search).get("max"))) || USUAL_POINTS);
// An index may grow by so much beyond that before it is sampled again.
const GROWTH = 1.25;
// The code of gRPC for a request that is wrong.
const INVALID_ARGUMENT = 3;
// The forms of payloads whose edges the stream tells.
const DECLARED = ["EDGES", "WEIGHTED_EDGES"];

/** An index whose points are followed from the construction to `close`. */
export class Layer {
  cloud = new Cloud();
  vertices = new Vertices();
  /** The generation of the cloud that is encoded in the vertices. */
  generation = -1;
  /** The space; undefined until the server has told it. */
  space = undefined;
  /** True if the index declares how its payloads hold edges. */
  declaresEdges = false;
  /** The server's words if it refuses the points. */
  refusal = "";
  /** True once everything up to some revision has come. */
  isComplete = false;
  #pauses = new Pauses();

  /**
   * `number` chooses the colour. `changed` is called when points came, `spaceKnown` when the space is known, and `madeAgain` when
   * another index has taken the name.
   */
  constructor(name, number, { changed, spaceKnown, madeAgain }) {
    this.name = name;
    this.number = number;
    this.changed = changed;
    this.spaceKnown = spaceKnown;
    this.madeAgain = madeAgain;
    this.past = new Past(name, this.cloud, changed);
    this.stream = followWhileVisible(() => this.#path(), {
      take: (head, body) => this.#take(head, body),
      state: (state, problem, code) => this.#report(state, problem, code),
    });
  }

  close() {
    this.isClosed = true;
    this.stream.stop();
    this.past.stop();
    this.#pauses.end();
    forget(`points of ${this.name}`);
  }

  // After a lost connection or a pause, only what came after the last whole revision is asked for: so the slider keeps what
  // it knows of removed points, and a sample stays the same sample.
  #path() {
    const path = `api/v1/${encodeURIComponent(this.name)}/points?max=${MAX_POINTS}&follow=true&edges=true`;
    if (this.reached === undefined) return path;
    // The connection may have ended within a message: the mutations before the newest one came whole.
    const after = Math.max(this.reached.number, this.cloud.newest - 1);
    // A uid has only letters that need no encoding.
    return `${path}&after=${this.reached.uid}:${after}&share=${this.cloud.share.fraction}`;
  }

  #report(state, problem = "", code = 0) {
    if (this.isClosed) return;
    // The server may have refused the revision: the next request asks for everything.
    if (code === INVALID_ARGUMENT) this.reached = undefined;
    report(`points of ${this.name}`, state, problem, code);
    this.refusal = problem;
  }

  #take(head, body) {
    const { cloud } = this;
    switch (head.kind) {
      case "begin": {
        const isAnother = cloud.uid !== undefined && cloud.uid !== head.revision.uid;
        this.past.stop();
        cloud.begin(head);
        this.isComplete = false;
        this.reached = undefined;
        if (isAnother) this.madeAgain();
        this.#askForSpace(head);
        break;
      }
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
        cloud.advanceTo(head.revision);
        this.reached = head.revision;
        this.isComplete = true;
        if (cloud.alive > GROWTH * MAX_POINTS) this.#sampleAgain();
        break;
      case "reset":
        // A new begin follows, and until then the old picture stays.
        this.reached = undefined;
        break;
    }
    this.changed();
  }

  // From here on, the stream tells only a smaller part of the points, and those outside of it are dropped here.
  #sampleAgain() {
    const { cloud } = this;
    this.past.stop();
    cloud.thin(new Share((cloud.share.fraction * MAX_POINTS) / cloud.alive));
    this.stream.restart();
  }

  // The stream does not tell the space, and an index of the same name may have another one after a `begin`.
  async #askForSpace({ revision: { uid }, coordinate_count }) {
    if (this.uidOfSpace === uid) return;
    const about = `description of ${this.name}`;
    report(about, "connecting");
    while (!this.isClosed && this.cloud.uid === uid) {
      try {
        const { index } = await call(this.name, "info", {});
        forget(about);
        if (this.isClosed || this.cloud.uid !== uid) return;
        this.#pauses.reset();
        this.uidOfSpace = uid;
        this.space = parseSpace(index.space_text, coordinate_count);
        this.declaresEdges = DECLARED.includes(index.payload_encoding);
        this.spaceKnown(this);
        return;
      } catch (error) {
        if (this.isClosed) break;
        if (error instanceof Refusal) report(about, "refused", error.message, error.code);
        else report(about, "retrying");
        await this.#pauses.next();
      }
    }
    forget(about);
  }
}

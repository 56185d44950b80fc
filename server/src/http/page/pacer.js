// Decides when a picture is drawn, and how many of the points.
//
// Drawing a million points in software takes a fifth of a second. While the picture moves, fewer points are drawn so that
// it follows the hand; once it rests, all of them. New points alone never take more than a part of the time.

import { MAX_THINNING } from "./renderer.js";

const MOVING_MS = 180;
// A frame of a moving picture may take this long.
const MOVING_FRAME_MS = 40;
// New points are shown this often at most, and so that drawing takes at most a third of the time.
const QUIET_MS = 100;
const QUIET_SHARE = 3;

/** Calls `draw(thinning)` when it is time; `draw` returns the number of vertices that it drew. */
export class Pacer {
  #wanted = false;
  #timer = 0;
  #frame = 0;
  #busy = false;
  #movedAt = -Infinity;
  #drawnAt = -Infinity;
  #cost = 0;
  #costOfVertex = 0;

  constructor(gl, draw, vertices) {
    this.gl = gl;
    this.draw = draw;
    this.vertices = vertices;
  }

  /** Asks for a picture, at once if it `moves`. */
  request(moves = false) {
    this.#wanted = true;
    if (moves) this.#movedAt = performance.now();
    if (moves) clearTimeout(this.#timer);
    if (moves) this.#timer = 0;
    this.#schedule();
  }

  get isMoving() {
    return performance.now() - this.#movedAt < MOVING_MS;
  }

  #schedule() {
    if (!this.#wanted || this.#busy || this.#timer || this.#frame) return;
    const pause = this.isMoving ? 0 : this.#drawnAt + Math.max(QUIET_MS, QUIET_SHARE * this.#cost) - performance.now();
    if (pause <= 0) {
      this.#frame = requestAnimationFrame(() => this.#run());
      return;
    }
    this.#timer = setTimeout(() => {
      this.#timer = 0;
      this.#frame = requestAnimationFrame(() => this.#run());
    }, pause);
  }

  #run() {
    this.#frame = 0;
    this.#wanted = false;
    const thinning = this.isMoving ? this.#thinning() : 1;
    const began = performance.now();
    const drawn = this.draw(thinning);
    this.#busy = true;
    const fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.#awaitFence(fence, began, drawn, thinning);
  }

  // Frames are not queued: the next one begins after the last was finished, which also tells its cost.
  #awaitFence(fence, began, drawn, thinning) {
    const { gl } = this;
    const waited = performance.now() - began;
    const isDone = !fence || gl.isContextLost() || waited > 5000 || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED;
    if (!isDone) {
      setTimeout(() => this.#awaitFence(fence, began, drawn, thinning), 4);
      return;
    }
    gl.deleteSync(fence);
    this.#busy = false;
    this.#cost = waited;
    this.#drawnAt = performance.now();
    if (drawn > 10_000) this.#costOfVertex = 0.7 * (waited / drawn) + 0.3 * (this.#costOfVertex || waited / drawn);
    // The rest of the points is drawn once the picture rests.
    if (thinning > 1) setTimeout(() => this.request(), MOVING_MS);
    this.#schedule();
  }

  #thinning() {
    const thinning = Math.ceil((this.vertices() * this.#costOfVertex) / MOVING_FRAME_MS);
    return Math.min(Math.max(thinning, 1), MAX_THINNING);
  }
}

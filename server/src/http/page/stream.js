// A stream of the server that is opened again whenever it ends or falls silent, with growing pauses.

import { Refusal, request } from "./api.js";
import { FrameReader } from "./frames.js";
import { Pauses } from "./pauses.js";

// The server says at least every ten seconds that a stream lives.
const MAX_SILENCE_MS = 25_000;
// A connection that lasted this long was good: the pauses begin from the first again.
const GOOD_MS = 5000;

const running = new Set();

/**
 * Reads `path()` and hands its frames to `take`, until `stop` of the result is called. `restart` asks for `path()` again at
 * once, and no frame of the old answer comes any more. `state` hears "connecting", "live", "silent", "retrying" and
 * "refused", the last with the server's words and code. `begin` is called at the start of each connection.
 */
export function follow(path, listener) {
  const stream = new Stream(path, listener);
  stream.run();
  return { stop: () => stream.stop(), restart: () => stream.restart() };
}

/** Asks for all streams again at once, for another identity. */
export function restartAll() {
  for (const stream of running) stream.restart();
}

/**
 * Acts like `follow` as long as the tab is visible: the tabs of a browser share the few connections that it has for a server. A
 * hidden tab has none, and `state` hears "paused". `path()` is asked for again once the tab is shown.
 */
export function followWhileVisible(path, listener) {
  let stream = null;
  const show = () => {
    if (document.hidden === (stream === null)) return;
    if (!document.hidden) {
      stream = follow(path, listener);
      return;
    }
    stream.stop();
    stream = null;
    listener.state("paused");
  };
  document.addEventListener("visibilitychange", show);
  if (document.hidden) listener.state("paused");
  show();
  const stop = () => {
    document.removeEventListener("visibilitychange", show);
    stream?.stop();
  };
  return { stop, restart: () => stream?.restart() };
}

class Stream {
  #pauses = new Pauses();
  #attempt = null;
  #isStopped = false;
  // Why the present attempt was given up: "stop", "restart" or "silence".
  #reason = "";

  constructor(path, { take, state, begin = () => {} }) {
    this.path = path;
    this.take = take;
    this.state = state;
    this.begin = begin;
  }

  stop() {
    this.#isStopped = true;
    running.delete(this);
    this.#pauses.end();
    this.#giveUp("stop");
  }

  restart() {
    this.#giveUp("restart");
    this.#pauses.end();
  }

  async run() {
    running.add(this);
    this.state("connecting");
    while (!this.#isStopped) {
      const began = performance.now();
      this.#reason = "";
      const refusal = await this.#readOnce();
      if (this.#isStopped) return;
      if (this.#reason === "restart") {
        this.state("connecting");
        continue;
      }
      if (refusal) this.state("refused", refusal.message, refusal.code);
      else this.state(this.#reason === "silence" ? "silent" : "retrying");
      if (performance.now() - began > GOOD_MS) this.#pauses.reset();
      await this.#pauses.next();
    }
  }

  // Reads until the connection ends. Returns what the server refused, or null.
  async #readOnce() {
    const attempt = new AbortController();
    this.#attempt = attempt;
    let watch = 0;
    const heard = () => {
      clearTimeout(watch);
      watch = setTimeout(() => this.#giveUp("silence"), MAX_SILENCE_MS);
    };
    try {
      const waits = { sending: heard, asking: () => clearTimeout(watch) };
      const response = await request(this.path(), { method: "POST", signal: attempt.signal }, waits);
      this.begin();
      const reader = response.body.getReader();
      const frames = new FrameReader((head, body) => this.#receive(attempt, head, body));
      while (!attempt.signal.aborted) {
        const { done, value } = await reader.read();
        if (done) break;
        heard();
        frames.push(value);
        if (!attempt.signal.aborted) this.state("live");
      }
      return null;
    } catch (error) {
      if (error instanceof Refusal) return error;
      // A TypeError is a lost connection.
      if (!(error instanceof TypeError) && error.name !== "AbortError") console.warn(error);
      return null;
    } finally {
      clearTimeout(watch);
      // A stream that `take` gave up is ended too.
      attempt.abort();
    }
  }

  #receive(attempt, head, body) {
    if (attempt.signal.aborted) return;
    if (head.kind !== "failed") this.take(head, body);
    else throw new Refusal(0, head.status.code ?? 0, head.status.message, head.status.details ?? []);
  }

  #giveUp(reason) {
    this.#reason = reason;
    this.#attempt?.abort();
  }
}

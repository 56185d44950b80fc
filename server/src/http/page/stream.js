// A stream of the server that is opened again whenever it ends, with growing pauses.

import { Refusal, request } from "./api.js";

const FIRST_PAUSE_MS = 250;
const MAX_PAUSE_MS = 5000;
// A connection that lasted this long was good: the pauses begin from the first again.
const GOOD_MS = 5000;

/**
 * Reads `path()` and hands its bytes to `receive`, until `stop` of the result is called. `state` hears "connecting",
 * "live", "retrying" and "refused", the last with the server's words. `begin` is called before the first bytes of each
 * connection.
 */
export function follow(path, listener) {
  const controller = new AbortController();
  run(path, listener, controller.signal);
  return { stop: () => controller.abort() };
}

async function run(path, { begin, receive, state }, stopped) {
  let pause = FIRST_PAUSE_MS;
  state("connecting");
  while (!stopped.aborted) {
    let refusal = null;
    let connectedAt = Infinity;
    const attempt = new AbortController();
    const abort = () => attempt.abort();
    stopped.addEventListener("abort", abort);
    try {
      const response = await request(path(), { method: "POST", signal: attempt.signal });
      connectedAt = performance.now();
      begin();
      const reader = response.body.getReader();
      for (;;) {
        const { done, value } = await reader.read();
        if (done) break;
        receive(value);
        state("live");
      }
    } catch (error) {
      if (stopped.aborted) return;
      // A TypeError is a lost connection.
      if (error instanceof Refusal) refusal = error;
      else if (!(error instanceof TypeError) && error.name !== "AbortError") console.warn(error);
    } finally {
      stopped.removeEventListener("abort", abort);
      // A stream that `receive` gave up is ended too.
      attempt.abort();
    }
    if (stopped.aborted) return;
    if (refusal) state("refused", refusal.message);
    else state("retrying");
    if (performance.now() - connectedAt > GOOD_MS) pause = FIRST_PAUSE_MS;
    await sleep(pause);
    pause = Math.min(2 * pause, MAX_PAUSE_MS);
  }
}

function sleep(milliseconds) {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}

// A stream of the server that is opened again whenever it ends, with growing pauses.

import { Refusal, request } from "./api.js";

const FIRST_PAUSE_MS = 250;
const MAX_PAUSE_MS = 5000;
// A connection that lasted this long was good: the pauses begin from the first again.
const GOOD_MS = 5000;
// A stream from which nothing comes for this long is taken for dead: the overview sends a line each second.
const SILENCE_MS = 15_000;

/**
 * Reads `path()` and hands its bytes to `receive`, until `stop` of the result is called. `state` hears "connecting",
 * "live", "retrying" and "refused", the last with the server's words and the status of HTTP. `begin` is called before the first bytes of each
 * connection. `silence` is false for streams that may rightly be quiet.
 */
export function follow(path, { begin, receive, state, silence = true }) {
  const controller = new AbortController();
  run(path, { begin, receive, state, silence }, controller.signal);
  return { stop: () => controller.abort() };
}

async function run(path, { begin, receive, state, silence }, stopped) {
  let pause = FIRST_PAUSE_MS;
  state("connecting");
  while (!stopped.aborted) {
    let refusal = null;
    let connectedAt = Infinity;
    const attempt = new AbortController();
    const abort = () => attempt.abort();
    stopped.addEventListener("abort", abort);
    try {
      const response = await request(path(), { signal: attempt.signal });
      connectedAt = performance.now();
      begin();
      const reader = response.body.getReader();
      for (;;) {
        const { done, value } = await unlessSilent(reader, silence, abort);
        if (done) break;
        receive(value);
        state("live");
      }
    } catch (error) {
      if (stopped.aborted) return;
      if (error instanceof Refusal) refusal = error;
      else if (!(error instanceof TypeError) && error.name !== "AbortError") console.warn(error);
    } finally {
      stopped.removeEventListener("abort", abort);
      attempt.abort();
    }
    if (stopped.aborted) return;
    if (refusal) state("refused", refusal.message, refusal.status);
    else state("retrying");
    if (performance.now() - connectedAt > GOOD_MS) pause = FIRST_PAUSE_MS;
    await sleep(pause);
    pause = Math.min(2 * pause, MAX_PAUSE_MS);
  }
}

async function unlessSilent(reader, silence, abort) {
  if (!silence) return reader.read();
  const timer = setTimeout(abort, SILENCE_MS);
  try {
    return await reader.read();
  } finally {
    clearTimeout(timer);
  }
}

function sleep(milliseconds) {
  return new Promise((resolve) => setTimeout(resolve, milliseconds));
}

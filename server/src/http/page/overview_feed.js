// What the server tells of itself each second while the page is visible. All parts of the page listen to it.

import { callServer } from "./api.js";
import { forget, report } from "./connection.js";
import { History } from "./history.js";
import { sampleOf } from "./metrics.js";
import { follow } from "./stream.js";

const STREAM = "overview";

const listeners = new Set();

/** The last minutes of samples. */
export const history = new History();

/** The newest sample; undefined before the first. */
export let newest;

/** Calls `listener` with each sample from now on, and with the newest at once. Returns a function that ends this. */
export function listen(listener) {
  listeners.add(listener);
  if (newest) listener(newest);
  return () => listeners.delete(listener);
}

/** Listens to the server for as long as the page lives. A page that nobody sees does not listen. */
export function start() {
  let stream = null;
  // The version and the durability, which change only with the process.
  let server = {};
  const open = () => {
    stream = follow(() => "api/v1/overview", {
      begin: async () => (server = await callServer("server", {}).catch(() => server)),
      take: (head) => head.kind === "overview" && take(sampleOf(server, head)),
      state: (state, problem) => report(STREAM, state, problem),
    });
  };
  const show = () => {
    if (!document.hidden && !stream) open();
    if (!document.hidden || !stream) return;
    stream.stop();
    stream = null;
    forget(STREAM);
  };
  document.addEventListener("visibilitychange", show);
  show();
}

function take(sample) {
  newest = sample;
  history.add(sample, performance.now());
  for (const listener of listeners) listener(sample);
}

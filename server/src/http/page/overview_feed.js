// The server's overview, which arrives each second while the page is visible. All parts of the page listen to it.

import { forgetAddresses } from "./addresses.js";
import { callServer } from "./api.js";
import { report } from "./connection.js";
import { History } from "./history.js";
import { sampleOf } from "./metrics.js";
import { followWhileVisible } from "./stream.js";

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
  followWhileVisible(() => "api/v1/overview", {
    begin: askForServer,
    take: (head) => head.kind === "overview" && take(head),
    state: (state, problem, code) => report(STREAM, state, problem, code),
  });
}

// The version and the durability, which change only with the process.
let server = {};
let lastHead = null;

async function askForServer() {
  // The server may have been started again, with other addresses.
  forgetAddresses();
  try {
    server = await callServer("server", {});
    if (lastHead) tell(sampleOf(server, lastHead));
  } catch {
    // The stream tells about the connection. Without the answer, two tiles stay empty.
  }
}

function take(head) {
  lastHead = head;
  const sample = sampleOf(server, head);
  history.add(sample, performance.now());
  tell(sample);
}

function tell(sample) {
  newest = sample;
  for (const listener of listeners) listener(sample);
}

// Looks at the server each second while the page is visible. All parts of the page listen to it.

import { Refusal } from "./api.js";
import { report } from "./connection.js";
import { History } from "./history.js";
import { lookAtServer } from "./metrics.js";

const PAUSE_MS = 1000;

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

/** Looks for as long as the page lives. */
export async function start() {
  for (;;) {
    try {
      // A page that nobody sees need not look.
      if (!document.hidden) take(await lookAtServer());
      report("overview", "live");
    } catch (error) {
      if (error instanceof Refusal) report("overview", "refused", error.message);
      else report("overview", "retrying");
    }
    await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
  }
}

function take(sample) {
  newest = sample;
  history.add(sample, performance.now());
  for (const listener of listeners) listener(sample);
}

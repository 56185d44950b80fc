// The state of all streams of the page as one line of words.

import { byId, setText } from "./dom.js";

const WORDS = {
  live: "live",
  paused: "paused while this tab is hidden",
  connecting: "connecting",
  retrying: "not connected, trying again",
  silent: "no word from the server, trying again",
  refused: "refused by the server",
};
// The worst state of any stream is shown.
const ORDER = ["refused", "silent", "retrying", "connecting", "paused", "live"];
const states = new Map();

/** Records the state of one stream; `problem` has the server's words if it refused the stream. */
export function report(stream, state, problem = "") {
  states.set(stream, { state, problem });
  show();
}

/** Forgets a stream that was closed on purpose. */
export function forget(stream) {
  states.delete(stream);
  show();
}

function show() {
  const all = [...states.values()];
  const worst = ORDER.find((state) => all.some((stream) => stream.state === state)) ?? "connecting";
  const status = byId("status");
  status.dataset.state = worst === "silent" ? "retrying" : worst;
  setText(status, WORDS[worst]);
  const problems = [...new Set(all.map((stream) => stream.problem).filter(Boolean))];
  const notice = byId("notice");
  notice.hidden = problems.length === 0;
  setText(notice, problems.join(" "));
}

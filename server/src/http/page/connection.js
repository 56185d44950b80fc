// The state of all streams of the page as one line of words.

import { useAnotherToken } from "./api.js";
import { byId, element, setText } from "./dom.js";
import { restartAll } from "./stream.js";

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
// The code of gRPC for an identity that may not do this.
const PERMISSION_DENIED = 7;

/** Records the state of one stream; `problem` and `code` are the server's if it refused the stream. */
export function report(stream, state, problem = "", code = 0) {
  states.set(stream, { state, problem, code });
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
  setText(byId("problems"), problems.join(" "));
  const isDenied = all.some(({ code }) => code === PERMISSION_DENIED);
  if (isDenied && !byId("another-token")) notice.append(tokenButton());
  if (!isDenied) byId("another-token")?.remove();
}

function tokenButton() {
  const ask = async () => {
    await useAnotherToken();
    restartAll();
  };
  return element("button", { type: "button", id: "another-token", text: "Use another token", on: { click: ask } });
}

// The dialog that asks for a token. Several requests that wait for one share a single dialog.

import { byId, setText } from "./dom.js";

let open = null;

/** Shows the dialog and waits for a token. `problem` says why the token before was refused. */
export function askForToken(problem) {
  open ??= ask(problem).finally(() => (open = null));
  return open;
}

function ask(problem) {
  const dialog = byId("sign-in");
  const input = byId("token");
  setText(byId("sign-in-error"), problem);
  return new Promise((resolve) => {
    const closed = () => {
      const typed = input.value.trim();
      // Escape closes a dialog too. Nothing can be shown without a token, so the dialog stays.
      if (!typed) return dialog.showModal();
      dialog.removeEventListener("close", closed);
      input.value = "";
      resolve(typed);
    };
    dialog.addEventListener("close", closed);
    dialog.showModal();
    input.focus();
  });
}

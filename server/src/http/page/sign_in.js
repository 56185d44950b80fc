// The dialog that asks for a token. Several requests that wait for one share a single dialog.

import { byId, setText } from "./dom.js";

let open = null;

/**
 * Shows the dialog and waits for a token. `problem` says why the token before was refused. Escape gives `usual`; without it, the
 * dialog stays, because nothing can be shown without a token.
 */
export function askForToken(problem, usual = "") {
  open ??= ask(problem, usual).finally(() => (open = null));
  return open;
}

function ask(problem, usual) {
  const dialog = byId("sign-in");
  const input = byId("token");
  setText(byId("sign-in-error"), problem);
  return new Promise((resolve) => {
    const closed = () => {
      const typed = input.value.trim() || usual;
      if (!typed) return dialog.showModal();
      // A header of a request can carry no others.
      if (!/^[\x21-\x7e]+$/.test(typed)) {
        setText(byId("sign-in-error"), "A token has only letters, digits and signs of ASCII, and no spaces.");
        return dialog.showModal();
      }
      dialog.removeEventListener("close", closed);
      input.value = "";
      resolve(typed);
    };
    dialog.addEventListener("close", closed);
    dialog.showModal();
    input.focus();
  });
}

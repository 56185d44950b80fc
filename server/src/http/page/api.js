// Requests to the server: the token, the errors in the server's words, and the verbs.

import { askForToken } from "./sign_in.js";

// The token is kept here and nowhere else: no cookie and no storage, so it is gone with the page.
let token = "";

/** An answer of the server that is no success, with its words. `code` is that of gRPC, or 0. */
export class Refusal extends Error {
  constructor(status, code, message, details) {
    super(message);
    this.status = status;
    this.code = code;
    this.details = details;
  }

  /** The field of the request that is wrong, such as `states[0].coords[3]`; empty if the server names none. */
  get field() {
    // A limit has the name of a setting: that of `k` is `max_k`.
    for (const detail of this.details) {
      const violation = (detail.field_violations ?? detail.fieldViolations ?? [])[0];
      if (violation) return violation.field ?? "";
      const limit = (detail.violations ?? [])[0]?.subject;
      if (limit) return limit.replace(/^max_/, "");
    }
    return "";
  }
}

/**
 * Sends a request with the token. On 401 it asks for one and sends the request again. `sending` is called before each attempt, and
 * `asking` before the dialog, because a person takes a while. Throws a `Refusal`.
 */
export async function request(path, options = {}, { sending = () => {}, asking = () => {} } = {}) {
  for (;;) {
    const sent = token;
    const headers = { ...options.headers };
    if (sent) headers.Authorization = `Bearer ${sent}`;
    sending();
    const response = await fetch(path, { ...options, headers, cache: "no-store", redirect: "error" });
    if (response.ok) return response;
    const refusal = await refusalOf(response);
    if (response.status !== 401) throw refusal;
    // Another request may have brought a newer token meanwhile: try that one before asking.
    if (token !== sent) continue;
    asking();
    token = await askForToken(sent ? refusal.message : "");
  }
}

/** Asks for another token, for an identity that may see more. Escape keeps the present one. */
export async function useAnotherToken() {
  token = await askForToken("", token);
}

async function refusalOf(response) {
  const text = await response.text();
  try {
    const status = JSON.parse(text);
    return new Refusal(response.status, status.code ?? 0, status.message || text, status.details ?? []);
  } catch {
    return new Refusal(response.status, 0, text.trim() || `The server answered ${response.status}.`, []);
  }
}

/** Calls a verb of an index, such as `knn`, with a JSON body. */
export async function call(index, verb, body) {
  return post(`api/v1/${encodeURIComponent(index)}/${verb}`, body);
}

/** Calls a verb of the server, such as `list`. */
export async function callServer(verb, body) {
  return post(`api/v1/${verb}`, body);
}

async function post(path, body) {
  const response = await request(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  return response.json();
}

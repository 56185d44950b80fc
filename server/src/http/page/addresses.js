// Where programs reach the server, and what they have to show it.

import { callServer } from "./api.js";

const ANY_HOST = /^(0\.0\.0\.0|\[::\])$/;

const USUAL_URI = "http://127.0.0.1:50051";

let known = null;

/** The address of gRPC for programs that run where the browser does, and whether they need a CA and a token. */
export async function serverForPrograms() {
  known ??= callServer("addresses", {}).catch((error) => {
    known = null;
    throw error;
  });
  const { grpc, has_identities } = await known;
  const [, host, port] = /^(.*):(\d+)$/.exec(grpc.address);
  const scheme = grpc.has_tls ? "https" : "http";
  return { uri: `${scheme}://${ANY_HOST.test(host) ? browserHost() : host}:${port}`, hasTls: grpc.has_tls, hasIdentities: has_identities };
}

/** Asks for the addresses again when they are needed. */
export function forgetAddresses() {
  known = null;
}

/** The options by which the command line reaches the server; none at the usual address. */
export function optionsFor({ uri, hasTls }) {
  return [...(uri === USUAL_URI ? [] : ["--server", uri]), ...(hasTls ? ["--ca", "ca.pem"] : [])];
}

/** Adds these options to a command, or none while the server does not tell its address. */
export async function commandForServer(command) {
  try {
    return [command, ...optionsFor(await serverForPrograms())].join(" ");
  } catch {
    return command;
  }
}

// A server that listens on every address is reached by the name that the browser uses for it. `localhost` may be ::1, where it
// does not listen.
function browserHost() {
  return location.hostname === "localhost" ? "127.0.0.1" : location.hostname;
}

// Where programs reach the server, and what they have to show it.

import { callServer } from "./api.js";

const ANY_HOST = /^(0\.0\.0\.0|\[::\])$/;

let known = null;

/** The address of gRPC for programs that run where the browser does, and whether they need a CA and a token. Asked once. */
export async function serverForPrograms() {
  known ??= callServer("addresses", {}).catch((error) => {
    known = null;
    throw error;
  });
  const { grpc, identities } = await known;
  const [, host, port] = /^(.*):(\d+)$/.exec(grpc.address);
  const scheme = grpc.tls ? "https" : "http";
  return { uri: `${scheme}://${ANY_HOST.test(host) ? browserHost() : host}:${port}`, hasTls: grpc.tls, hasIdentities: identities };
}

// A server that listens on every address is reached by the name that the browser uses for it. `localhost` may be ::1, where it
// does not listen.
function browserHost() {
  return location.hostname === "localhost" ? "127.0.0.1" : location.hostname;
}

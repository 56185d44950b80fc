// The same search as text: for the command line, Rust, Python and C++. The calls are those of the docs.

import { optionsFor } from "./addresses.js";

/**
 * The texts of a search, with their names. `search` has `index`, `state`, and `k`, `radius`, `epsilon`, `tag` if given; `server`
 * is that of `serverForPrograms`.
 */
export function snippets(search, server) {
  return [
    { name: "Command line", text: commandLine(search, server) },
    { name: "Rust", text: rust(search, server) },
    { name: "Python", text: python(search, server) },
    { name: "C++", text: cpp(search, server) },
  ];
}

function commandLine({ index, state, k, radius, epsilon, tag }, server) {
  const words = ["wayfold", k === undefined ? "query" : "knn", index, `--state=${state.join()}`];
  if (k !== undefined) words.push("-k", k);
  if (radius !== undefined) words.push("--radius", radius);
  if (epsilon) words.push("--epsilon", epsilon);
  if (tag) words.push("--tag", `${hex(tag.value)}/${hex(tag.mask)}`);
  words.push(...optionsFor(server));
  const line = words.join(" ");
  return server.hasIdentities ? `# Your token is read from the environment: WAYFOLD_TOKEN.\n${line}` : line;
}

// The methods of a search have the same names in Rust and in C++.
function methods({ k, radius, epsilon, tag }) {
  const calls = [];
  if (k !== undefined) calls.push(`k(${k})`);
  if (radius !== undefined) calls.push(`${k === undefined ? "within" : "radius"}(${float(radius)})`);
  if (tag) calls.push(`tag(${hex(tag.mask)}, ${hex(tag.value)})`);
  if (epsilon) calls.push(`epsilon(${float(epsilon)})`);
  return calls.join(".");
}

function rust(search, { uri, hasTls, hasIdentities }) {
  const hasCredentials = hasTls || hasIdentities;
  return lines(
    `use wayfold::{${hasCredentials ? "Credentials, " : ""}Index, Search};`,
    "",
    hasCredentials && "let credentials = Credentials::new()",
    hasTls && `    .ca_certificate(std::fs::read("ca.pem")?)${hasIdentities ? "" : ";"}`,
    hasIdentities && '    .token(std::env::var("WAYFOLD_TOKEN")?);',
    `let index = Index::remote("${uri}", "${search.index}")${hasCredentials ? ".credentials(credentials)" : ""}.open()?;`,
    `let state = [${search.state.map(float).join(", ")}];`,
    `let found = index.search(state, &Search::${methods(search).replace("Infinity", "f64::INFINITY")})?;`,
    "for neighbor in &found.neighbors {",
    '    println!("{} {}", neighbor.id, neighbor.distance);',
    "}",
  );
}

function python({ index, state, k, radius, epsilon, tag }, { uri, hasTls, hasIdentities }) {
  const options = [];
  if (k !== undefined) options.push(k);
  if (radius !== undefined) options.push(`radius=${radius === Infinity ? 'float("inf")' : radius}`);
  if (tag) options.push(`tag=(${hex(tag.mask)}, ${hex(tag.value)})`);
  if (epsilon) options.push(`epsilon=${epsilon}`);
  const hasCredentials = hasTls || hasIdentities;
  return lines(
    hasIdentities && "import os",
    hasTls && "import pathlib",
    hasCredentials && "",
    "import wayfold",
    "",
    hasCredentials ? "index = wayfold.remote(" : `index = wayfold.remote("${uri}", "${index}")`,
    hasCredentials && `    "${uri}", "${index}",`,
    hasTls && '    ca_certificate=pathlib.Path("ca.pem").read_bytes(),',
    hasIdentities && '    token=os.environ["WAYFOLD_TOKEN"],',
    hasCredentials && ")",
    `found = index.search([${state.join(", ")}], wayfold.Search(${options.join(", ")}))`,
    "for id, distance in zip(found.ids, found.distances):",
    "    print(id, distance)",
  );
}

function cpp(search, { uri, hasTls, hasIdentities }) {
  const hasCredentials = hasTls || hasIdentities;
  return lines(
    "#include <wayfold/wayfold.hpp>",
    "#include <cmath>",
    hasIdentities && "#include <cstdlib>",
    hasTls && "#include <fstream>",
    "#include <iostream>",
    hasTls && "#include <iterator>",
    "",
    hasCredentials && "wayfold::Credentials credentials;",
    hasTls && 'std::ifstream ca("ca.pem");',
    hasTls && "credentials.ca_certificate(std::string(std::istreambuf_iterator<char>(ca), {}));",
    hasIdentities && 'credentials.token(std::getenv("WAYFOLD_TOKEN"));',
    `const auto index = wayfold::Index::remote("${uri}", "${search.index}"${hasCredentials ? ", {}, credentials" : ""});`,
    `const std::vector<double> state{${search.state.map(float).join(", ")}};`,
    `for (const auto &near : index.search(state, wayfold::Search::${methods(search).replace("Infinity", "INFINITY")})) {`,
    "    std::cout << near.id << ' ' << near.distance << '\\n';",
    "}",
  );
}

function lines(...all) {
  return all.filter((line) => line !== false).join("\n");
}

/** A number that Rust and C++ take for one of floating point. */
function float(number) {
  const text = String(number);
  return /^-?\d+$/.test(text) ? `${text}.0` : text;
}

function hex(number) {
  return `0x${number.toString(16)}`;
}

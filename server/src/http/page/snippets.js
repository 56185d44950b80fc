// The same search as text: for the command line, Rust, Python and C++. The calls are those of the docs.

/** The texts of a search, with their names. `search` has `index`, `state`, and `k`, `radius`, `epsilon`, `tag` if given. */
export function snippets(search) {
  return [
    { name: "Command line", text: commandLine(search) },
    { name: "Rust", text: rust(search) },
    { name: "Python", text: python(search) },
    { name: "C++", text: cpp(search) },
  ];
}

/** The address of gRPC: the page is served by the same machine, at the default port unless that was changed. */
function address() {
  const host = location.hostname || "127.0.0.1";
  return `${location.protocol}//${host === "localhost" ? "127.0.0.1" : host}:50051`;
}

function commandLine({ index, state, k, radius, epsilon, tag }) {
  const words = ["wayfold", k === undefined ? "query" : "knn", index, `--state=${state.join()}`];
  if (k !== undefined) words.push("-k", k);
  if (radius !== undefined) words.push("--radius", radius);
  if (epsilon) words.push("--epsilon", epsilon);
  if (tag) words.push("--tag", `${hex(tag.value)}/${hex(tag.mask)}`);
  if (address() !== "http://127.0.0.1:50051") words.push("--server", address());
  return words.join(" ");
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

function rust(search) {
  return [
    "use wayfold::{Index, Search};",
    "",
    `let index = Index::remote("${address()}", "${search.index}").open()?;`,
    `let state = [${search.state.map(float).join(", ")}];`,
    `let found = index.search(state, &Search::${methods(search).replace("Infinity", "f64::INFINITY")})?;`,
    "for neighbor in &found.neighbors {",
    '    println!("{} {}", neighbor.id, neighbor.distance);',
    "}",
  ].join("\n");
}

function python({ index, state, k, radius, epsilon, tag }) {
  const options = [];
  if (k !== undefined) options.push(k);
  if (radius !== undefined) options.push(`radius=${radius === Infinity ? 'float("inf")' : radius}`);
  if (tag) options.push(`tag=(${hex(tag.mask)}, ${hex(tag.value)})`);
  if (epsilon) options.push(`epsilon=${epsilon}`);
  return [
    "import wayfold",
    "",
    `index = wayfold.remote("${address()}", "${index}")`,
    `found = index.search([${state.join(", ")}], wayfold.Search(${options.join(", ")}))`,
    "for id, distance in zip(found.ids, found.distances):",
    "    print(id, distance)",
  ].join("\n");
}

function cpp(search) {
  return [
    "#include <wayfold/wayfold.hpp>",
    "#include <cmath>",
    "#include <iostream>",
    "",
    `const auto index = wayfold::Index::remote("${address()}", "${search.index}");`,
    `const std::vector<double> state{${search.state.map(float).join(", ")}};`,
    `for (const auto &near : index.search(state, wayfold::Search::${methods(search).replace("Infinity", "INFINITY")})) {`,
    "    std::cout << near.id << ' ' << near.distance << '\\n';",
    "}",
  ].join("\n");
}

/** A number that Rust and C++ take for one of floating point. */
function float(number) {
  const text = String(number);
  return /^-?\d+$/.test(text) ? `${text}.0` : text;
}

function hex(number) {
  return `0x${number.toString(16)}`;
}

// The overview: the server in tiles, the indices and the calls in tables.

import { commandForServer } from "./addresses.js";
import { byId, element, keyed, setText } from "./dom.js";
import { bytes, count, counted, duration, rate, short } from "./format.js";
import { history, listen } from "./overview_feed.js";
import { draw, sparkline } from "./sparkline.js";

const DURABILITY = {
  FSYNC: "survives a loss of power",
  OS: "survives the end of the process",
  NONE: "survives an orderly stop",
  MEMORY: "in memory only, survives nothing",
};
const COLUMNS = 10;

/** Shows the overview until the returned function is called. */
export function show() {
  byId("overview").hidden = false;
  document.title = "Wayfold";
  setText(byId("place"), "Overview");
  const stop = listen(update);
  return () => {
    stop();
    byId("overview").hidden = true;
  };
}

function update(sample) {
  const tiles = tilesOf(sample);
  keyed(byId("tiles"), tiles, (tile) => tile.name, makeTile, updateTile);
  updateIndices(sample);
  updateCalls(sample.hasFigures);
}

// An identity of only some indices reads this text in place of figures.
const NO_FIGURES = "figures need an identity that may read /metrics";

function tilesOf({ server, indices, hasFigures }) {
  const points = indices.reduce((sum, index) => sum + Number(index.pointCount), 0);
  const calls = history.calls(() => true);
  // Each percentile stays on one line.
  const percentiles = [`p50 ${duration(calls.p50)},`, `p99 ${duration(calls.p99)}`].map((text) => text.replaceAll(" ", "\u00a0")).join(" ");
  const figures = hasFigures ? { value: rate(calls.rate), more: percentiles } : { value: "–", more: NO_FIGURES };
  const tiles = [
    { name: "Server", value: server.state, more: server.version && `version ${server.version}`, words: true },
    { name: "Durability", value: server.durability || "–", more: DURABILITY[server.durability] ?? "", words: true },
    { name: "Points", value: short(points), more: `in ${indices.length} ${indices.length === 1 ? "index" : "indices"}` },
    { name: "Calls a second", ...figures },
  ];
  if (server.memory) tiles.push(usage("Memory", server.memory));
  if (server.disk) tiles.push(usage("Disk", server.disk));
  if (server.members > 0) tiles.push({ name: "Cluster", value: count(server.members), more: "members" });
  return tiles;
}

function usage(name, { used, high, limit }) {
  return {
    name,
    value: bytes(Number(used)),
    more: `of ${bytes(Number(limit))}`,
    share: Number(used) / Number(limit),
    bad: Number(used) >= Number(high),
  };
}

function makeTile({ name, words, share }) {
  const meter = share !== undefined && element("div", { class: "meter", "aria-hidden": "true" }, element("div"));
  return element(
    "div",
    { class: words ? "tile words" : "tile" },
    element("div", { class: "name", text: name }),
    element("div", { class: "value" }),
    element("div", { class: "more" }),
    meter,
  );
}

function updateTile(tile, { value, more, share, bad }) {
  const [, shown, below, meter] = tile.children;
  setText(shown, value);
  setText(below, more);
  if (meter) meter.firstElementChild.style.width = `${100 * Math.min(share, 1)}%`;
  tile.classList.toggle("bad", Boolean(bad));
}

/** The problem of an index and its remedy; undefined if there is none. */
function problemOf(index) {
  if (index.problem) return { ...index.problem, grave: true };
  if (!history.isLagging(index.name)) return undefined;
  return {
    what: `Readers of this index are ${counted(index.lag, "revision")} behind its log.`,
    advice: "If the lag grows, the server or the link to its subscribers is overloaded: write less, or give it more cores.",
    grave: false,
  };
}

function updateIndices({ indices, hasFigures }) {
  byId("indices").hidden = indices.length === 0;
  if (indices.length === 0 && byId("indices-empty").hidden) showCreateHint();
  byId("indices-empty").hidden = indices.length > 0;
  const rank = (row) => (row.problem ? (row.problem.grave ? 0 : 1) : 2);
  const rows = indices.map((index) => ({ index, problem: problemOf(index), hasFigures }));
  rows.sort((a, b) => rank(a) - rank(b) || a.index.name.localeCompare(b.index.name));
  // A problem has a row of its own below that of its index.
  const all = rows.flatMap((row) => (row.problem ? [row, { ...row, isAdvice: true }] : [row]));
  const key = (row) => (row.isAdvice ? `${row.index.name} advice` : row.index.name);
  keyed(byId("indices").tBodies[0], all, key, makeRow, updateRow);
}

async function showCreateHint() {
  setText(byId("create-hint"), await commandForServer("wayfold create arm --space 'R3*SO3:0.15'"));
}

function makeRow({ index, isAdvice }) {
  if (isAdvice) return element("tr", { class: "advice" }, element("td", { colspan: COLUMNS }, element("strong"), " ", element("span")));
  const link = element("a", { href: `#/${encodeURIComponent(index.name)}`, text: index.name });
  const cell = (label, ...children) => element("td", { class: "n", data: { label } }, element("span", { class: "number" }), ...children);
  return element(
    "tr",
    { data: { index: index.name } },
    element("th", { scope: "row" }, link, element("span", { class: "space" }), element("span", { class: "mark" })),
    cell("points"),
    cell("points/s", sparkline("insert")),
    cell("calls/s", sparkline("knn")),
    cell("p50"),
    cell("p99"),
    cell("revision"),
    cell("memory"),
    cell("subscribers"),
    cell("lag"),
  );
}

function updateRow(row, { index, problem, isAdvice, hasFigures }) {
  if (isAdvice) {
    row.classList.toggle("grave", problem.grave);
    setText(row.querySelector("strong"), problem.what);
    setText(row.querySelector("span"), problem.advice);
    return;
  }
  const [name, ...cells] = row.children;
  setText(name.querySelector(".space"), index.space);
  setText(name.querySelector(".mark"), index.owned ? "" : "kept by another member");
  const ofIndex = (call) => call.index === index.name;
  const calls = history.calls(ofIndex);
  const figure = (text) => (hasFigures ? text : "–");
  const texts = [
    count(index.pointCount), rate(history.pointRate(index.name)), figure(rate(calls.rate)), duration(calls.p50), duration(calls.p99),
    count(index.revision.number), bytes(Number(index.memoryBytes)), figure(count(index.subscribers)), figure(count(index.lag)),
  ];
  texts.forEach((text, i) => setText(cells[i].firstElementChild, text));
  const now = performance.now();
  draw(cells[1].lastElementChild, history.pointCurve(index.name), now);
  draw(cells[2].lastElementChild, history.callCurve(index.name), now);
}

function updateCalls(hasFigures) {
  setText(byId("calls-empty"), hasFigures ? "No calls within the last minute." : `These ${NO_FIGURES}.`);
  const kinds = history.kinds();
  byId("calls").hidden = kinds.length === 0;
  byId("calls-empty").hidden = kinds.length > 0;
  keyed(byId("calls").tBodies[0], kinds, (kind) => kind.key, makeCall, updateCall);
}

function makeCall({ verb, index, face, outcome }) {
  const cell = (label, text) => element("td", { data: { label }, text });
  const number = (label) => element("td", { class: "n", data: { label } });
  const shown = cell("outcome", outcome);
  if (outcome !== "OK") shown.classList.add("bad");
  return element(
    "tr", {},
    element("th", { scope: "row", text: verb }), cell("index", index || "–"), cell("over", face), shown,
    number("calls/s"), number("p50"), number("p99"), number("since the start"),
  );
}

function updateCall(row, kind) {
  const numbers = [rate(kind.rate), duration(kind.p50), duration(kind.p99), count(kind.count)];
  numbers.forEach((text, i) => setText(row.children[4 + i], text));
}

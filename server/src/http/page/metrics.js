// A sample of the server: the list of its indices, and the metrics that operators scrape.

const DAMAGE_ADVICE =
  "Copy the data directory before anything else. In a cluster the index may heal by itself. Otherwise follow the reason: run " +
  "wayfold-server repair if it says so; if not, restore a snapshot under another name before you delete this index.";

/**
 * The content of the overview at one moment. `server` is the answer of the verb of that name. `metrics` is null for an identity
 * that may not see all indices; `hasFigures` is false then.
 */
export function sampleOf(server, { list, metrics: text }) {
  const metrics = parse(text ?? "");
  const { calls, bounds } = callsOf(metrics);
  return {
    server: {
      version: server.version ?? "",
      durability: server.durability ?? "",
      state: stateOf(metrics),
      memory: resource(metrics, "memory"),
      disk: resource(metrics, "disk"),
      members: find(metrics, "wayfold_cluster_members", { state: "live" }) ?? 0,
    },
    hasFigures: text !== null,
    indices: [...list.indexes.map((index) => indexOf(index, metrics)), ...list.damaged.map(damagedOf)],
    calls,
    bounds,
  };
}

/** The lines of a text of metrics: by name, each with its labels and its number. */
export function parse(text) {
  const metrics = new Map();
  for (const [, name, labels, number] of text.matchAll(/^(\w+)(?:\{(.*)\})? (\S+)$/gm)) {
    const found = Object.fromEntries([...(labels ?? "").matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)].map(([, key, value]) => [key, value]));
    if (!metrics.has(name)) metrics.set(name, []);
    metrics.get(name).push({ labels: found, number: Number(number) });
  }
  return metrics;
}

function find(metrics, name, labels) {
  return metrics.get(name)?.find((line) => Object.entries(labels).every(([key, value]) => line.labels[key] === value))?.number;
}

function stateOf(metrics) {
  if (!metrics.has("wayfold_ready")) return "answering";
  const states = metrics.get("wayfold_ready").filter(({ number }) => number === 1);
  return states.map(({ labels }) => labels.state).join(", ") || "not ready";
}

function resource(metrics, name) {
  const [used, high, limit] = ["used", "high", "limit"].map((of) => find(metrics, "wayfold_resource_bytes", { resource: name, of }));
  return used === undefined || limit === undefined ? null : { used, high: high ?? limit, limit };
}

function indexOf(index, metrics) {
  const figure = (name) => find(metrics, `wayfold_index_${name}`, { index: index.name }) ?? 0;
  return {
    name: index.name,
    space: index.space_text,
    pointCount: index.point_count,
    revision: index.revision,
    memoryBytes: index.memory_bytes,
    subscribers: figure("subscribers"),
    lag: figure("subscriber_lag"),
    // Only servers of a cluster tell this.
    owned: (find(metrics, "wayfold_index_owned", { index: index.name }) ?? 1) === 1,
    problem: null,
  };
}

function damagedOf({ name, uid, error }) {
  const none = { space: "", pointCount: 0, revision: { uid, number: 0 }, memoryBytes: 0, subscribers: 0, lag: 0 };
  const problem = { what: error.message, advice: DAMAGE_ADVICE };
  return { name, ...none, owned: true, problem };
}

/** The calls, whose buckets in the text count everything up to their bound. */
function callsOf(metrics) {
  const calls = new Map();
  const keyOf = ({ face, verb, index, outcome }) => [face, verb, index, outcome].join("\n");
  for (const { labels, number } of metrics.get("wayfold_call_seconds_bucket") ?? []) {
    const { face, verb, index, outcome, le } = labels;
    const call = calls.get(keyOf(labels)) ?? { face, verb, index, outcome, ups: [] };
    call.ups.push({ bound: le === "+Inf" ? Infinity : Number(le), number });
    calls.set(keyOf(labels), call);
  }
  let bounds = [];
  const made = [...calls.values()].map(({ ups, ...call }) => {
    ups.sort((a, b) => a.bound - b.bound);
    bounds = ups.slice(0, -1).map(({ bound }) => bound);
    const buckets = ups.map(({ number }, i) => number - (ups[i - 1]?.number ?? 0));
    return { ...call, count: ups.at(-1).number, buckets };
  });
  return { calls: made, bounds };
}

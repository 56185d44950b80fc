// The last five minutes of the server's samples, and what they say about rates and latencies.

const KEPT_MS = 5 * 60_000;
const RECENT_MS = 60_000;
// The calls that last for as long as their callers wish, or as there are points: their times are no latencies.
const STREAMS = new Set(["watch", "scan", "snapshot", "restore", "verify", "stream_knn", "points", "overview"]);

/** Samples of the overview with their times of arrival. */
export class History {
  #samples = [];

  /** Takes a sample. A server that restarted counts from 0 again, so what came before is forgotten. */
  add(sample, now) {
    const calls = new Map(sample.calls.map((call) => [keyOf(call), { ...call, count: Number(call.count) }]));
    const points = new Map(sample.indices.map((index) => [index.name, Number(index.pointCount)]));
    const last = this.#samples.at(-1);
    const isRestarted = last && [...last.calls].some(([key, call]) => (calls.get(key)?.count ?? 0) < call.count);
    // The first figures after samples without any have counted since the start of the server, not since the last sample.
    if (isRestarted || last?.hasFigures !== sample.hasFigures) this.#samples = [];
    // A curve of five minutes is drawn for each index each second, so its sums are made once.
    const counts = new Map();
    for (const { index, count } of calls.values()) counts.set(index, (counts.get(index) ?? 0) + count);
    const lags = new Map(sample.indices.map((index) => [index.name, Number(index.lag)]));
    this.#samples.push({ at: now, calls, counts, points, lags, bounds: sample.bounds, hasFigures: sample.hasFigures });
    const oldest = now - KEPT_MS;
    while (this.#samples.length > 2 && this.#samples[0].at < oldest) this.#samples.shift();
  }

  /** True if the index had a lag in each of the last ten samples: a lag of a moment is nothing to tell. */
  isLagging(index) {
    const last = this.#samples.slice(-10);
    return last.length === 10 && last.every((sample) => (sample.lags.get(index) ?? 0) > 0);
  }

  /** New points a second over the last minute; negative if points were removed. */
  pointRate(index) {
    const [recent, to] = this.#recent();
    // An index may be younger than a minute.
    const from = recent && this.#samples.find((sample) => sample.at >= recent.at && sample.points.has(index));
    if (!from || from === to || !to.points.has(index)) return 0;
    return (to.points.get(index) - from.points.get(index)) / seconds(from, to);
  }

  /** The calls that `accept` holds for, over the last minute: a second, and the two percentiles in seconds, without streams. */
  calls(accept) {
    const [from, to] = this.#recent();
    return from ? between(from, to, [...to.calls].filter(([, call]) => accept(call))) : { rate: 0, p50: null, p99: null };
  }

  /** The kinds of calls of the last minute, the most frequent first. */
  kinds() {
    const [from, to] = this.#recent();
    if (!from) return [];
    const kinds = [...to.calls].map(([key, call]) => ({ ...call, key, ...between(from, to, [[key, call]]) }));
    return kinds.filter((kind) => kind.rate > 0).sort((a, b) => b.rate - a.rate);
  }

  /** The points of a curve over the last five minutes: one number for each pair of samples that `value` is given. */
  curve(value) {
    const numbers = [];
    for (let i = 1; i < this.#samples.length; i++) {
      numbers.push({ at: this.#samples[i].at, value: value(this.#samples[i - 1], this.#samples[i]) });
    }
    return numbers;
  }

  /** The curve of new points a second of an index. */
  pointCurve(index) {
    const known = (sample) => sample.points.get(index);
    return this.curve((from, to) => Math.max(0, ((known(to) ?? 0) - (known(from) ?? known(to) ?? 0)) / seconds(from, to)));
  }

  /** The curve of calls a second of an index. */
  callCurve(index) {
    const known = (sample) => sample.counts.get(index) ?? 0;
    return this.curve((from, to) => (known(to) - known(from)) / seconds(from, to));
  }

  #recent() {
    const to = this.#samples.at(-1);
    const from = this.#samples.find((sample) => sample.at >= to.at - RECENT_MS);
    return from && from !== to ? [from, to] : [undefined, to];
  }
}

function keyOf({ face, verb, index, outcome }) {
  return [face, verb, index, outcome].join("\n");
}

function seconds(from, to) {
  return Math.max((to.at - from.at) / 1000, 1e-3);
}

/** The calls between two samples, of these entries of the later one. */
function between(from, to, entries) {
  let count = 0;
  const buckets = new Array(to.bounds.length + 1).fill(0);
  for (const [key, call] of entries) {
    const before = from.calls.get(key);
    count += call.count - (before?.count ?? 0);
    if (STREAMS.has(call.verb)) continue;
    call.buckets.forEach((number, i) => (buckets[i] += Number(number) - Number(before?.buckets[i] ?? 0)));
  }
  return {
    rate: count / seconds(from, to),
    p50: percentile(buckets, to.bounds, 0.5),
    p99: percentile(buckets, to.bounds, 0.99),
  };
}

/** The percentile of a histogram, interpolated within its bucket; null without calls, infinite in the last bucket. */
export function percentile(buckets, bounds, share) {
  const all = buckets.reduce((sum, number) => sum + number, 0);
  if (all <= 0) return null;
  let left = share * all;
  for (let i = 0; i < buckets.length; i++) {
    if (buckets[i] >= left && buckets[i] > 0) {
      if (i === bounds.length) return Infinity;
      const low = i === 0 ? 0 : bounds[i - 1];
      return low + (left / buckets[i]) * (bounds[i] - low);
    }
    left -= buckets[i];
  }
  return Infinity;
}

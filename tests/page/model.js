// Random histories of an index, told to the page's cloud as frames, and held against a model of the index: its points, where
// they are, its edges, and the same at every earlier revision. Returns the number of comparisons. `model_steps.py` runs it.
async ({ seed, rounds }) => {
  const { Cloud, ALIVE } = await import("./cloud.js");
  const { Replay } = await import("./replay.js");
  const { Share } = await import("./share.js");
  const IDS = 40;
  let comparisons = 0;

  const random = () => {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    return seed / 2 ** 32;
  };
  const below = (most) => Math.floor(random() * most);
  const some = (make) => Array.from({ length: below(4) }, make);
  const assert = (isSo, ...what) => {
    if (!isSo) throw new Error(what.join(" "));
  };

  // Frames as the server sends them: a head and a body.
  const pointsFrame = (points) => {
    const count = points.length;
    const body = new ArrayBuffer(28 * count + 8);
    const [wholes, floats] = [new Uint32Array(body), new Float32Array(body)];
    points.forEach(({ id, revision, tag, x }, i) => {
      [wholes[2 * i], wholes[2 * count + 2 * i], wholes[4 * count + 2 * i], floats[6 * count + i]] = [id, revision, tag, x];
    });
    return [{ kind: "points", row_count: count }, body];
  };
  const edgesFrame = (points) => {
    const pairs = points.flatMap(({ id, edges }) => edges.map((other) => [id, other]));
    const columns = [0, 1].flatMap((end) => pairs.flatMap((pair) => [pair[end], 0]));
    return [{ kind: "edges", row_count: pairs.length }, new Uint32Array(columns).buffer];
  };
  const revisionOf = (number) => ({ uid: "u", number });
  const idsFrame = (kind, ids, number) => {
    return [{ kind, row_count: ids.length, revision: revisionOf(number) }, new Uint32Array(ids.flatMap((id) => [id, 0])).buffer];
  };
  const take = (cloud, frames) => {
    for (const [head, body] of frames) {
      if (head.kind === "points") cloud.append(head, body);
      if (head.kind === "edges") cloud.edges.append(head, body, cloud.slots);
      if (head.kind === "removed") cloud.remove(head, body);
      if (head.kind === "at") cloud.advanceTo(head.revision);
    }
  };

  /** The index: its points by id, and its points and frames by revision. */
  class Model {
    points = new Map();
    revision = 0;
    past = [new Map()];
    log = [[]];

    // A mutation, and its frames for a share.
    step(share) {
      const revision = ++this.revision;
      const frames = [];
      const send = (kind, make, all) => {
        const sent = all.filter((one) => share.has(one.id ?? one, 0));
        const frame = sent.length > 0 && make(kind, sent, revision);
        if (frame && frame[0].row_count > 0) frames.push(frame);
      };
      const known = [...this.points.keys()];
      let stored = [];
      const choice = below(4);
      if (choice < 2) {
        const ids = [...new Set([below(IDS), ...some(() => below(IDS))])];
        stored = ids.map((id) => ({ id, revision, tag: 0, x: random(), edges: some(() => below(IDS)) }));
        send("replaced", idsFrame, ids.filter((id) => this.points.has(id)));
      } else if (choice === 2 && known.length > 0) {
        stored = [{ ...this.points.get(known[below(known.length)]), tag: below(4), edges: some(() => below(IDS)) }];
      }
      for (const point of stored) this.points.set(point.id, point);
      send("points", (_, points) => pointsFrame(points), stored);
      send("edges", (_, points) => edgesFrame(points), stored);
      const removed = choice === 3 ? known.filter(() => random() < 0.12) : [];
      for (const id of removed) this.points.delete(id);
      send("removed", idsFrame, removed);
      frames.push([{ kind: "at", revision: revisionOf(revision) }, new ArrayBuffer(0)]);
      this.log.push(frames);
      this.past.push(new Map(this.points));
      return frames;
    }
  }

  const compareNow = (cloud, model, share) => {
    const inSample = [...model.points.values()].filter(({ id }) => share.has(id, 0));
    assert(cloud.alive === inSample.length, "alive", cloud.alive, inSample.length);
    const name = (a, b) => [a, b].sort((one, other) => one - other).join();
    const expected = new Set();
    for (const { id, edges } of inSample) {
      for (const other of edges) if (other !== id && model.points.has(other) && share.has(other, 0)) expected.add(name(id, other));
    }
    const drawn = [];
    const { pairs, length } = cloud.edges;
    for (let i = 0; i < length; i++) {
      const [a, b] = [pairs[2 * i], pairs[2 * i + 1]];
      if (a !== b && cloud.died[a] === ALIVE && cloud.died[b] === ALIVE) drawn.push(name(cloud.ids[2 * a], cloud.ids[2 * b]));
    }
    assert(drawn.length === expected.size && drawn.every((edge) => expected.has(edge)), "edges", drawn, "not", [...expected]);
    assert(cloud.edges.countAt(ALIVE - 1, cloud) === expected.size, "the count of edges");
    comparisons += 1;
  };

  const comparePast = (cloud, model, share) => {
    for (let revision = cloud.knownFrom; revision <= model.revision; revision++) {
      const then = new Map([...model.past[revision]].filter(([id]) => share.has(id, 0)));
      assert(cloud.countAt(revision) === then.size, "count at", revision, cloud.countAt(revision), then.size);
      let drawn = 0;
      for (let slot = 0; slot < cloud.length; slot++) {
        if (cloud.born[slot] > revision || revision >= cloud.died[slot]) continue;
        drawn += 1;
        assert(Math.fround(then.get(cloud.ids[2 * slot])?.x) === cloud.rows[slot], "place at", revision);
      }
      if (revision < cloud.newest) assert(drawn + cloud.lostAt(revision) === then.size, "lost at", revision);
      comparisons += 1;
    }
  };

  for (let round = 0; round < rounds; round++) {
    let share = new Share(round % 3 === 0 ? 0.7 : 1);
    const model = new Model();
    for (let i = 20 + below(120); i > 0; i--) model.step(share);
    const [begun, oldest] = [model.revision, below(model.revision)];
    const cloud = new Cloud();
    const counts = { coordinate_count: 1, point_count: 0 };
    cloud.begin({ revision: revisionOf(begun), oldest_revision: revisionOf(oldest), ...counts, share: share.fraction });
    const all = [...model.points.values()].filter(({ id }) => share.has(id, 0));
    take(cloud, [pointsFrame(all), edgesFrame(all), [{ kind: "at", revision: revisionOf(begun) }, new ArrayBuffer(0)]]);
    const live = (steps) => {
      for (let i = 0; i < steps; i++) {
        // A connection ends within a message, and goes on as that of a layer does.
        const reached = model.revision;
        const message = [model.step(share), ...some(() => model.step(share))].flat().filter(([{ kind }]) => kind !== "at");
        take(cloud, message.slice(0, below(message.length + 1)));
        take(cloud, model.log.slice(Math.max(reached, cloud.newest - 1) + 1).flat());
        compareNow(cloud, model, share);
      }
    };
    live(below(20));
    const until = cloud.knownFrom;
    if (oldest < until) {
      const replay = new Replay(cloud);
      for (const frames of model.log.slice(oldest + 1, until + 1)) for (const [head, body] of frames) replay.take(head, body);
      cloud.adopt(replay.cloud, replay.lost);
    }
    comparePast(cloud, model, share);
    live(below(100));
    comparePast(cloud, model, share);
    if (round % 4 !== 0) continue;
    share = new Share(share.fraction * 0.6);
    cloud.thin(share);
    comparePast(cloud, model, share);
    live(40);
    comparePast(cloud, model, share);
  }
  return comparisons;
}

// The page of one or several indices: it joins the picture, the settings, the probe and the slider.

import { commandForServer } from "./addresses.js";
import { forget, report } from "./connection.js";
import { byId, setText } from "./dom.js";
import { about, count, counted } from "./format.js";
import { Layer } from "./layer.js";
import { listen, newest } from "./overview_feed.js";
import { categories, onThemeChange } from "./palette.js";
import { Picture } from "./picture.js";
import { Probe } from "./probe.js";
import { Timeline } from "./timeline.js";
import { ViewPanel } from "./view_panel.js";

// The numbers of a growing index change this often at most.
const SHOWN_MS = 100;

// Each index takes a connection for as long as it is shown. Without TLS a browser has six for a server: one is for the
// overview, and one is left for calls.
const MAX_LAYERS = performance.getEntriesByType("navigation")[0]?.nextHopProtocol === "h2" ? 8 : 4;
const TOO_MANY = "number of indices";

// The parts listen to the elements of the page, which stay. So they are made once and serve all pages of indices.
let parts;

/** The page while it is shown. */
export class IndexPage {
  #layers = [];
  #timer = 0;

  constructor() {
    byId("index").hidden = false;
    parts ??= makeParts();
    parts.page = this;
    this.stop = listen(() => this.#update());
  }

  /** Shows these indices. Those that are shown already keep their points. */
  show(requested) {
    const names = requested.slice(0, MAX_LAYERS);
    if (names.length < requested.length) report(TOO_MANY, "live", `At most ${MAX_LAYERS} indices are shown in one picture.`);
    else forget(TOO_MANY);
    const kept = this.#layers.filter((layer) => names.includes(layer.name));
    for (const layer of this.#layers) if (!kept.includes(layer)) layer.close();
    // A revision of other indices says nothing of these.
    if (kept.length === 0) parts.timeline.goLive();
    this.#layers = kept;
    for (const name of names) if (!kept.some((layer) => layer.name === name)) this.#layers.push(this.#open(name));
    document.title = `${names.join(", ")} · Wayfold`;
    setText(byId("place"), names.join(", "));
    this.spaceKnown();
  }

  close() {
    this.stop();
    forget(TOO_MANY);
    for (const layer of this.#layers) layer.close();
    this.#layers = [];
    parts.picture?.setLayers([]);
    parts.picture?.setMarks(null);
    parts.page = null;
    byId("index").hidden = true;
  }

  /** The layers of the picture. Indices whose rows differ cannot share one: those like the first are drawn. */
  get drawn() {
    const known = this.#layers.filter((layer) => layer.space);
    return known.filter((layer) => layer.space.names.join() === known[0].space.names.join());
  }

  get layers() {
    return this.#layers;
  }

  /** The layers changed, or the space of one is known now. */
  spaceKnown() {
    const { drawn } = this;
    this.recolor();
    parts.picture?.setLayers(drawn);
    parts.view.setLayers(this.#layers, drawn);
    if (drawn.length > 0) parts.view.setSpace(drawn[0].space);
    parts.probe.setLayers(drawn, this.#layers);
    this.changed();
  }

  /** Gives the layers the colours of the present theme. */
  recolor() {
    const colors = categories();
    for (const layer of this.#layers) layer.color = colors[layer.number % colors.length];
  }

  /** Points came. A planner may send a thousand frames a second, so what follows from them is done less often. */
  changed() {
    if (this.#timer === 0) this.#timer = setTimeout(() => this.#show(), SHOWN_MS);
  }

  #show() {
    this.#timer = 0;
    if (parts.page !== this) return;
    parts.timeline.update();
    // Without a picture, its place says why.
    if (!parts.picture) return;
    parts.picture.pacer.request();
    if (this.drawn.some((layer) => layer.isComplete) && this.drawn.every((layer) => layer.cloud.length === 0)) this.#showEmpty();
    else byId("empty").hidden = true;
  }

  /** Another revision is shown, or another number of points. */
  describe(revision) {
    parts.probe.showRevision(parts.timeline.isLive ? 0 : revision);
    const layers = this.drawn.filter(({ cloud }) => cloud.edges);
    const lines = parts.picture?.linesAt(revision);
    const words = layers.map((layer) => sampleOf(layer, revision));
    if (lines && lines.lines < lines.points) words.push(`draws ${count(lines.lines)} of ${count(lines.points)} points, sampled evenly`);
    if (!lines) words.push(...edgesAt(layers, revision));
    setText(byId("sampled"), words.filter(Boolean).join(" · "));
  }

  /** After each frame. */
  drawnFrame() {
    const layers = this.drawn;
    if (document.documentElement.dataset.ready || !layers.some(({ cloud, isComplete }) => cloud.length > 0 || isComplete)) return;
    performance.mark("first-picture");
    document.documentElement.dataset.ready = "1";
  }

  #open(name) {
    const used = this.#layers.map((layer) => layer.number);
    let number = 0;
    while (used.includes(number)) number += 1;
    return new Layer(name, number, {
      changed: () => this.changed(),
      spaceKnown: () => this.spaceKnown(),
      // A revision of the former index says nothing of the new one.
      madeAgain: () => parts.timeline.goLive(),
    });
  }

  #update() {
    parts.view.setLayers(this.#layers, this.drawn);
  }

  async #showEmpty() {
    const { name, space } = this.drawn[0];
    const empty = byId("empty");
    empty.hidden = false;
    const state = space.factors.map(({ kind, size }) => (kind === "SO3" ? "0,0,0,1" : Array(size).fill("0").join())).join();
    const command = await commandForServer(`wayfold insert ${name} -`);
    setText(empty, `This index has no points yet. They appear here as they come, for example by: echo ${state} | ${command}`);
  }
}

/** A note on an index of which only a part is in the picture. */
function sampleOf({ name, cloud }, revision) {
  if (cloud.length === undefined || cloud.share.isWhole) return "";
  if (revision < cloud.newest) return `shows ${count(cloud.countAt(revision))} of ${about(cloud.estimateAt(revision))} points, sampled evenly`;
  const all = Number(newest?.indices.find((index) => index.name === name)?.pointCount ?? cloud.total);
  // Between two samples of the overview the picture may be ahead of it.
  return `shows ${count(cloud.alive)} of ${count(Math.max(all, cloud.alive))} points, sampled evenly`;
}

/** A note on the edges at a revision. */
function edgesAt(layers, revision) {
  const declaring = layers.filter(({ declaresEdges }) => declaresEdges);
  const edges = declaring.reduce((sum, { cloud }) => sum + cloud.edges.countAt(revision, cloud), 0);
  const isFull = declaring.some(({ cloud }) => cloud.edges.isFull);
  return [edges > 0 && counted(edges, "edge"), isFull && "there are more"];
}

function makeParts() {
  const made = { page: null };
  const clicked = (hit) => hit && made.probe.probePoint(hit.layer, hit.slot);
  try {
    made.picture = new Picture(clicked);
    made.picture.onDrawn = () => made.page?.drawnFrame();
  } catch (error) {
    // Without WebGL2 the probe and the tables still work.
    setText(byId("empty"), error.message);
    byId("empty").hidden = false;
  }
  made.timeline = new Timeline(() => made.page?.drawn ?? [], made.picture, () => made.page?.describe(made.timeline.revision));
  made.view = new ViewPanel(made.picture, () => made.page?.changed());
  made.probe = new Probe(made.picture, made.view);
  onThemeChange(() => made.page?.spaceKnown());
  return made;
}

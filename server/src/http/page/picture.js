// The picture of the points: its layers, its view, its colours and its revision.

import { ALIVE } from "./cloud.js";
import { byId, setText } from "./dom.js";
import { listen } from "./gestures.js";
import { Pacer } from "./pacer.js";
import { onThemeChange } from "./palette.js";
import { ParallelView } from "./parallel.js";
import { Renderer } from "./renderer.js";
import { COLOR_MODE } from "./shaders.js";
import { SpatialView } from "./spatial.js";

// Beyond two device pixels a CSS pixel, more of them cost time and show nothing.
const MAX_PIXEL_RATIO = 2;
// A click means a point within this distance.
const REACH_PIXELS = 10;
const VIEWS = {
  spatial: {
    hint: "drag to turn · wheel or pinch to zoom · click a point to probe it",
    label: "Points in three dimensions. Arrow keys turn, plus and minus zoom, 0 resets, a click probes the nearest point, and Enter the point nearest the middle.",
  },
  parallel: {
    hint: "each line is a point · click a line to probe it",
    label: "Points as lines through one axis for each coordinate. A click probes the point of the nearest line, and Enter that of the line nearest the middle.",
  },
};

/** The picture. A layer is `{ cloud, vertices, color, generation }`, whose `cloud` grows. */
export class Picture {
  #layers = [];
  #projection = null;
  #marks = { probe: null, neighbors: [], labels: [], highlight: -1 };
  #coloring = { mode: COLOR_MODE.flat, colorOf: () => () => 0 };

  /** The newest revision of all, unless the slider holds an older one. */
  revision = ALIVE - 1;
  pointSize = 3;
  hasEdges = true;
  /** Called after each frame. */
  onDrawn = () => {};

  constructor(clicked) {
    this.root = byId("picture");
    this.renderer = new Renderer(byId("points"));
    this.spatial = new SpatialView(this.renderer);
    this.parallel = new ParallelView(this.renderer);
    const vertices = () => this.#view.verticesOf?.(this.#scene) ?? this.#layers.reduce((sum, layer) => sum + layer.cloud.length, 0);
    this.pacer = new Pacer(this.renderer.gl, (thinning) => this.#draw(thinning), vertices);
    listen(this.root, this.spatial.camera, {
      moved: () => {
        if (this.isParallel) return;
        byId("hint").hidden = true;
        this.pacer.request(true);
      },
      reset: () => this.lookAtAll(),
      clicked: (x, y) => clicked(this.#view.pick(this.#scene, x, y, REACH_PIXELS)),
      entered: () => clicked(this.#view.pick(this.#scene, this.root.clientWidth / 2, this.root.clientHeight / 2, Infinity)),
    });
    new ResizeObserver(() => (this.spatial.camera.isMoved ? this.pacer.request(true) : this.lookAtAll())).observe(this.root);
    onThemeChange(() => {
      this.renderer.setPalette();
      this.pacer.request();
    });
    this.renderer.onRestored = () => {
      this.parallel.prepare();
      for (const layer of this.#layers) layer.builtEdges = undefined;
      this.encodeAll();
    };
  }

  /** True while points are lines through parallel axes. */
  get isParallel() {
    return Boolean(this.#projection?.isParallel);
  }

  /** Draws these layers from now on. */
  setLayers(layers) {
    for (const layer of this.#layers.filter((layer) => !layers.includes(layer))) {
      this.spatial.drop(layer);
      this.parallel.drop(layer);
    }
    this.#layers = layers;
    this.#forgetBounds();
    this.pacer.request();
  }

  /** Draws by another projection. */
  setProjection(projection) {
    this.#projection = projection;
    const view = this.isParallel ? "parallel" : "spatial";
    byId("index").dataset.view = view;
    this.root.setAttribute("aria-label", VIEWS[view].label);
    setText(byId("hint"), VIEWS[view].hint);
    byId("hint").hidden = false;
    this.#forgetBounds();
    if (!this.isParallel) this.spatial.measure(this.#scene);
    this.lookAtAll();
  }

  /** Colours the points: `mode` of the shader, and `colorOf(cloud)`, which gives a function of slots. */
  setColoring(coloring) {
    this.#coloring = coloring;
    this.encodeAll();
  }

  /** Shows a probe and its neighbours, given as rows of coordinates with a label each; `null` shows none. */
  setMarks(probe, neighbors = [], labels = []) {
    this.#marks = { probe, neighbors, labels, highlight: -1 };
    this.pacer.request();
  }

  /** Shows one neighbour more strongly, or none for −1. */
  setHighlight(neighbor) {
    if (this.#marks.highlight === neighbor) return;
    this.#marks.highlight = neighbor;
    this.pacer.request(true);
  }

  /** Goes so near to the probe that its neighbours fill the picture. */
  lookAtProbe() {
    this.spatial.lookAtProbe(this.#scene);
    this.pacer.request(true);
  }

  /** Turns the camera to see the whole box. */
  lookAtAll() {
    this.spatial.lookAtAll(this.#scene);
    this.pacer.request(true);
  }

  /** Encodes all points again before the next frame. */
  encodeAll() {
    for (const layer of this.#layers) layer.generation = -1;
    this.pacer.request();
  }

  /** The numbers of lines at a revision, and of the points that they stand for; null in another view. */
  linesAt(revision) {
    return this.isParallel ? this.parallel.countAt(this.#layers, revision) : null;
  }

  get #view() {
    return this.isParallel ? this.parallel : this.spatial;
  }

  get #scene() {
    const { clientWidth: width, clientHeight: height } = this.root;
    const { revision, pointSize, hasEdges } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
    const newest = Math.min(revision, Math.max(1, ...this.#layers.map((layer) => layer.cloud.newest ?? 0)));
    const settings = { coloring: this.#coloring, marks: this.#marks, projection: this.#projection, pointSize, hasEdges };
    return { layers: this.#layers, width, height, ratio, revision, newest, ...settings };
  }

  #forgetBounds() {
    this.spatial.forgetBounds();
    this.parallel.forgetBounds();
  }

  #draw(thinning) {
    const scene = this.#scene;
    const { width, height, ratio } = scene;
    if (width === 0 || height === 0 || !this.#projection) return 0;
    this.renderer.begin(Math.round(width * ratio), Math.round(height * ratio));
    const drawn = this.#view.draw(scene, thinning);
    this.onDrawn();
    return drawn;
  }
}

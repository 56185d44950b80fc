// The picture of the points: what is drawn, from where, in which colours and at which revision.

import { drawAxes } from "./axes.js";
import { Bounds, boxOf, placeInBox } from "./bounds.js";
import { Camera } from "./camera.js";
import { ALIVE } from "./cloud.js";
import { byId } from "./dom.js";
import { drawable } from "./edges.js";
import { listen } from "./gestures.js";
import { drawMarks } from "./marks.js";
import { Pacer } from "./pacer.js";
import { onThemeChange, rgb } from "./palette.js";
import { pick } from "./picker.js";
import { Renderer } from "./renderer.js";
import { COLOR_MODE } from "./shaders.js";

// Beyond two device pixels a CSS pixel, more of them cost time and show nothing.
const MAX_PIXEL_RATIO = 2;

/** The picture. A layer is `{ cloud, vertices, color, generation }`, whose `cloud` grows. */
export class Picture {
  #layers = [];
  #projection = null;
  #fit = null;
  #bounds = null;
  #box = [1, 1, 1];
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
    this.camera = new Camera();
    const vertices = () => this.#layers.reduce((sum, layer) => sum + layer.cloud.length, 0);
    this.pacer = new Pacer(this.renderer.gl, (thinning) => this.#draw(thinning), vertices);
    listen(this.root, this.camera, {
      moved: () => {
        byId("hint").hidden = true;
        this.pacer.request(true);
      },
      reset: () => this.lookAtAll(),
      clicked: (x, y) => clicked(this.#pick(x, y)),
    });
    new ResizeObserver(() => (this.camera.isMoved ? this.pacer.request(true) : this.lookAtAll())).observe(this.root);
    onThemeChange(() => {
      this.renderer.setPalette();
      this.pacer.request();
    });
    this.renderer.onRestored = () => {
      for (const layer of this.#layers) layer.builtEdges = undefined;
      this.encodeAll();
    };
  }

  /** Draws these layers from now on. */
  setLayers(layers) {
    for (const layer of this.#layers) {
      if (layers.includes(layer)) continue;
      this.renderer.drop(layer);
      layer.builtEdges = undefined;
    }
    this.#layers = layers;
    this.#bounds = null;
    this.pacer.request();
  }

  /** Draws by another projection. */
  setProjection(projection) {
    this.#projection = projection;
    this.#bounds = null;
    this.#measure();
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
    const { probe, neighbors } = this.#marks;
    if (!probe || !this.#fit) return;
    const center = this.#place(probe);
    const reach = (row) => Math.hypot(...this.#place(row).map((at, axis) => at - center[axis]));
    this.camera.lookAt(center, Math.max(1e-4, ...neighbors.map(reach)));
    this.pacer.request(true);
  }

  /** Turns the camera to see the whole box. */
  lookAtAll() {
    this.camera.aspect = this.root.clientWidth / this.root.clientHeight || 1;
    this.camera.reset(this.#box);
    this.pacer.request(true);
  }

  /** Encodes all points again before the next frame. */
  encodeAll() {
    for (const layer of this.#layers) layer.generation = -1;
    this.pacer.request();
  }

  // Brings the box up to date with the points.
  #measure() {
    const shown = this.#layers.filter((layer) => layer.cloud.coordinates !== undefined);
    if (!this.#projection || shown.length === 0) return;
    this.#bounds ??= new Bounds(shown[0].cloud.coordinates);
    let isWider = this.#fit === null || this.#fit.projection !== this.#projection;
    for (const layer of shown) isWider = this.#bounds.include(layer.cloud) || isWider;
    if (!isWider) return;
    const { low, high } = this.#bounds;
    const isKnown = low[0] <= high[0];
    const unit = { low: low.map(() => 0), high: high.map(() => 1) };
    this.#fit = { projection: this.#projection, ...this.#projection.fit(isKnown ? this.#bounds : unit) };
    const box = boxOf(this.#fit);
    const isOther = box.some((edge, axis) => Math.abs(edge - this.#box[axis]) > 0.3);
    this.#box = box;
    for (const layer of shown) layer.generation = -1;
    if (isOther || !this.camera.isMoved) this.lookAtAll();
  }

  #encode(layer) {
    const { cloud, vertices } = layer;
    if (cloud.coordinates === undefined) return;
    let { from, to } = cloud.changed;
    if (layer.generation !== cloud.generation) [from, to] = [0, cloud.length];
    layer.generation = cloud.generation;
    cloud.changed = { from: 0, to: 0 };
    vertices.length = cloud.length;
    if (from >= to) return;
    vertices.encode(cloud, from, to, this.#fit, this.#coloring.colorOf(cloud));
    this.renderer.upload(layer, vertices, from, to);
  }

  #encodeEdges(layer) {
    const edges = layer.cloud.edges;
    if (!edges || layer.cloud.length === 0) return;
    const { projection, wraps } = this.#fit;
    const built = layer.builtEdges;
    const isSame = built?.edges === edges && built.generation === edges.generation && built.projection === projection;
    const from = isSame ? built.length : 0;
    layer.builtEdges = { edges, generation: edges.generation, projection, length: edges.length };
    if (from === edges.length && isSame) return;
    this.renderer.addEdges(layer, drawable(edges, from, edges.length, layer.vertices, wraps), !isSame);
  }

  #draw(thinning) {
    const { clientWidth: width, clientHeight: height } = this.root;
    if (width === 0 || height === 0) return 0;
    this.#measure();
    if (!this.#fit) return 0;
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
    this.camera.aspect = width / height;
    const matrix = this.camera.matrix();
    this.renderer.begin(Math.round(width * ratio), Math.round(height * ratio));
    const newest = Math.min(this.revision, Math.max(1, ...this.#layers.map((layer) => layer.cloud.newest ?? 0)));
    let drawn = 0;
    for (const layer of this.#layers) {
      this.#encode(layer);
      this.#encodeEdges(layer);
      this.renderer.draw(layer, layer.vertices.length, thinning, {
        view: matrix,
        box: this.#box,
        revision: this.revision,
        mode: this.#coloring.mode,
        color: rgb(layer.color).map((part) => part / 255),
        ages: [0, 1 / newest],
        // From near, points are larger, but much less than by the zoom.
        size: this.pointSize * ratio * Math.min(Math.max(Math.sqrt(this.camera.zoom), 1), 3),
        distance: this.camera.distance,
        hasEdges: this.hasEdges,
      });
      drawn += layer.vertices.length / thinning;
    }
    const { ranges } = this.#fit;
    const place = (row) => this.#place(row);
    const { probe, neighbors, labels, highlight } = this.#marks;
    const { axes: names, isNumbered } = this.#projection;
    drawAxes(byId("axes"), { matrix, eye: this.camera.eye(), box: this.#box, ranges, names, isNumbered, width, height });
    const marks = { probe: probe && place(probe), neighbors: neighbors.map(place), labels, highlight };
    drawMarks(byId("marks"), { matrix, ...marks, width, height });
    this.onDrawn();
    return drawn;
  }

  // The place in the picture of a row of coordinates.
  #place(row) {
    const { ranges, project } = this.#fit;
    const out = [0, 0, 0];
    project(row, 0, out);
    return placeInBox(out, ranges, this.#box);
  }

  #pick(x, y) {
    const { clientWidth: width, clientHeight: height } = this.root;
    const view = { matrix: this.camera.matrix(), box: this.#box, revision: this.revision, width, height };
    return pick(this.#layers, view, x, y);
  }
}

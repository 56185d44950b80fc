// The view of points in three dimensions, by a projection of their coordinates.

import { drawAxes } from "./axes.js";
import { Bounds, boxOf, placeInBox } from "./bounds.js";
import { Camera } from "./camera.js";
import { byId } from "./dom.js";
import { drawable } from "./edges.js";
import { drawMarks } from "./marks.js";
import { rgb } from "./palette.js";
import { pick } from "./picker.js";

/** The view. A scene has what all views share: layers, marks, colours, the revision, and the size of the canvas. */
export class SpatialView {
  camera = new Camera();
  #fit = null;
  #bounds = null;
  #box = [1, 1, 1];

  constructor(renderer) {
    this.renderer = renderer;
  }

  /** The layers or the projection changed. */
  forgetBounds() {
    this.#bounds = null;
  }

  /** Frees what a layer took. */
  drop(layer) {
    this.renderer.drop(layer);
    layer.builtEdges = undefined;
  }

  /** Turns the camera to see the whole box of a scene. */
  lookAtAll({ width, height }) {
    this.camera.aspect = width / height || 1;
    this.camera.reset(this.#box);
  }

  /** Goes so near to the probe that its neighbours fill the picture. */
  lookAtProbe({ marks: { probe, neighbors } }) {
    if (!probe || !this.#fit) return;
    const center = this.#place(probe);
    const distance = (row) => Math.hypot(...this.#place(row).map((at, axis) => at - center[axis]));
    this.camera.lookAt(center, Math.max(1e-4, ...neighbors.map(distance)));
  }

  /** Brings the box up to date with the points. */
  measure(scene) {
    const { layers, projection } = scene;
    const shown = layers.filter((layer) => layer.cloud.coordinateCount !== undefined);
    if (!projection || shown.length === 0) return;
    this.#bounds ??= new Bounds(shown[0].cloud.coordinateCount);
    let isWider = this.#fit === null || this.#fit.projection !== projection;
    for (const layer of shown) isWider = this.#bounds.include(layer.cloud) || isWider;
    if (!isWider) return;
    this.#fit = { projection, ...projection.fit(this.#bounds.orUnit()) };
    const box = boxOf(this.#fit);
    const isOther = box.some((edge, axis) => Math.abs(edge - this.#box[axis]) > 0.3);
    this.#box = box;
    for (const layer of shown) layer.generation = -1;
    if (isOther || !this.camera.isMoved) this.lookAtAll(scene);
  }

  /** Draws a scene, and each `thinning`-th of its points. Returns the number of vertices. */
  draw(scene, thinning) {
    this.measure(scene);
    if (!this.#fit) return 0;
    const { layers, width, height, ratio, marks } = scene;
    this.camera.aspect = width / height;
    const matrix = this.camera.matrix();
    let drawn = 0;
    for (const layer of layers) {
      this.#encode(layer, scene.coloring);
      this.#encodeEdges(layer);
      this.renderer.draw(layer, layer.vertices.length, thinning, {
        view: matrix,
        box: this.#box,
        revision: scene.revision,
        mode: scene.coloring.mode,
        color: rgb(layer.color).map((part) => part / 255),
        ages: [0, 1 / scene.newest],
        // From near, points are larger, but much less than by the zoom.
        size: scene.pointSize * ratio * Math.min(Math.max(Math.sqrt(this.camera.zoom), 1), 3),
        distance: this.camera.distance,
        hasEdges: scene.hasEdges && layer.declaresEdges,
      });
      drawn += layer.vertices.length / thinning;
    }
    const { axes: names, isNumbered } = scene.projection;
    const { ranges } = this.#fit;
    drawAxes(byId("axes"), { matrix, eye: this.camera.eye(), box: this.#box, ranges, names, isNumbered, width, height });
    const place = (row) => this.#place(row);
    const places = { probe: marks.probe && place(marks.probe), neighbors: marks.neighbors.map(place) };
    drawMarks(byId("marks"), { matrix, ...marks, ...places, width, height });
    return drawn;
  }

  /** The layer and slot of the point nearest to a place of the canvas within `maxPixels` pixels, or null. */
  pick({ layers, revision, width, height }, x, y, maxPixels) {
    return pick(layers, { matrix: this.camera.matrix(), box: this.#box, revision, width, height }, x, y, maxPixels);
  }

  #encode(layer, coloring) {
    const { cloud, vertices } = layer;
    if (cloud.coordinateCount === undefined) return;
    let { from, to } = cloud.changed;
    if (layer.generation !== cloud.generation) [from, to] = [0, cloud.length];
    layer.generation = cloud.generation;
    cloud.changed = { from: 0, to: 0 };
    vertices.length = cloud.length;
    if (from >= to) return;
    vertices.encode(cloud, from, to, this.#fit, coloring.colorOf(cloud));
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

  // The place in the picture of a row of coordinates.
  #place(row) {
    const { ranges, project } = this.#fit;
    const out = [0, 0, 0];
    project(row, 0, out);
    return placeInBox(out, ranges, this.#box);
  }
}

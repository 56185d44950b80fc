// The view of points as lines through parallel axes, one for each coordinate.

import { Bounds } from "./bounds.js";
import { byId } from "./dom.js";
import { LineRenderer, TEXTURE_WIDTH } from "./line_renderer.js";
import { LineSample } from "./line_sample.js";
import { rgb } from "./palette.js";
import { drawParallelAxes, drawParallelMarks, layoutOf, shareOf } from "./parallel_axes.js";

// More lines than this hide each other, and drawing them in software takes more than a fifth of a second.
const MAX_LINES = matchMedia("(max-width: 560px)").matches ? 5_000 : 20_000;
// A click beside the last axis means the lines at it.
const EDGE_PIXELS = 5;
const ALPHA = { least: 0.06, most: 0.9 };

/** The view. A scene is that of `SpatialView`. */
export class ParallelView {
  #bounds = null;
  #layout = null;
  #samples = new Map();

  constructor(renderer) {
    this.renderer = renderer;
    this.lines = new LineRenderer(renderer);
  }

  /** After the graphics processor has lost everything. */
  prepare() {
    this.lines.prepare();
  }

  /** The layers or the projection changed. */
  forgetBounds() {
    this.#bounds = null;
  }

  /** Frees what a layer took. */
  drop(layer) {
    this.lines.drop(layer);
    this.#samples.delete(layer);
  }

  /** The numbers of lines at a revision, and of the points that they stand for. */
  countAt(layers, revision) {
    let [lines, points] = [0, 0];
    for (const layer of layers.filter(({ cloud }) => cloud.length !== undefined)) {
      lines += this.#sampleOf(layer).countAt(revision, layer.cloud);
      points += layer.cloud.countAt(revision) - layer.cloud.lostAt(revision);
    }
    return { lines, points };
  }

  verticesOf({ layers }) {
    return layers.reduce((sum, layer) => sum + this.#sampleOf(layer).slots.length * (layer.cloud.coordinateCount ?? 0), 0);
  }

  /** Draws a scene, and each `thinning`-th of its lines. Returns the number of vertices. */
  draw(scene, thinning) {
    const shown = scene.layers.filter(({ cloud }) => cloud.coordinateCount !== undefined);
    if (shown.length === 0) return 0;
    this.#bounds ??= new Bounds(shown[0].cloud.coordinateCount);
    for (const { cloud } of shown) this.#bounds.include(cloud);
    const layout = layoutOf(scene.projection.space, this.#bounds.orUnit(), scene.width, scene.height);
    this.#layout = layout;
    const counts = shown.map((layer) => this.#sampleOf(layer).countAt(scene.revision, layer.cloud));
    const visible = counts.reduce((sum, count) => sum + count, 0) / thinning;
    const alpha = Math.min(Math.max(10 / Math.sqrt(visible), ALPHA.least), ALPHA.most);
    let drawn = 0;
    for (const layer of shown) {
      const { slots } = this.#sampleOf(layer);
      this.#upload(layer, slots, layout, scene.coloring.colorOf(layer.cloud));
      this.lines.draw(layer, slots.length, thinning, {
        frame: frameOf(layout),
        axes: layout.axes.length,
        revision: scene.revision,
        mode: scene.coloring.mode,
        color: rgb(layer.color).map((part) => part / 255),
        age: 1 / scene.newest,
        alpha,
      });
      drawn += (slots.length * layout.axes.length) / thinning;
    }
    drawParallelAxes(byId("axes"), layout);
    drawParallelMarks(byId("marks"), layout, scene.marks);
    return drawn;
  }

  /** The layer and slot of the line nearest to a place of the canvas within `maxPixels` pixels, or null. */
  pick({ layers, revision }, x, y, maxPixels) {
    const { axes, top, bottom } = this.#layout ?? { axes: [] };
    const right = axes.findIndex((axis) => axis.x >= x - EDGE_PIXELS);
    if (right < 0) return null;
    const to = Math.max(right, 1);
    const [first, second] = [axes[to - 1], axes[to]];
    const along = Math.min(Math.max((x - first.x) / (second.x - first.x), 0), 1);
    let best = null;
    let least = maxPixels;
    for (const layer of layers) {
      const { born, died, rows, coordinateCount } = layer.cloud;
      for (const slot of this.#sampleOf(layer).slots) {
        if (born[slot] > revision || died[slot] <= revision) continue;
        const [a, b] = [first, second].map((axis, i) => bottom - (bottom - top) * shareOf(axis, rows[slot * coordinateCount + to - 1 + i]));
        const slope = (b - a) / (second.x - first.x);
        const apart = Math.abs(a + along * (b - a) - y) / Math.hypot(1, slope);
        if (apart >= least) continue;
        least = apart;
        best = { layer, slot };
      }
    }
    return best;
  }

  // The sample of a layer, up to date.
  #sampleOf(layer) {
    const { cloud } = layer;
    if (!this.#samples.has(layer)) {
      const most = Math.min(MAX_LINES, Math.floor(TEXTURE_WIDTH ** 2 / Math.max(cloud.coordinateCount ?? 1, 1)));
      this.#samples.set(layer, new LineSample(most));
    }
    const sample = this.#samples.get(layer);
    if (cloud.length !== undefined) sample.update(cloud);
    return sample;
  }

  #upload(layer, slots, { axes }, colorOf) {
    const { rows, born, died, coordinateCount } = layer.cloud;
    const lines = new Uint32Array(3 * slots.length);
    const values = new Float32Array(TEXTURE_WIDTH * Math.max(1, Math.ceil((slots.length * coordinateCount) / TEXTURE_WIDTH)));
    slots.forEach((slot, i) => {
      lines[3 * i] = born[slot];
      lines[3 * i + 1] = died[slot];
      lines[3 * i + 2] = colorOf(slot);
      for (let c = 0; c < coordinateCount; c++) values[coordinateCount * i + c] = shareOf(axes[c], rows[coordinateCount * slot + c]);
    });
    this.lines.upload(layer, lines, values);
  }
}

// The frame of the axes from −1 to 1: left, bottom, right, top.
function frameOf({ axes, top, bottom, width, height }) {
  const across = (x) => (2 * x) / width - 1;
  const up = (y) => 1 - (2 * y) / height;
  return [across(axes[0].x), up(bottom), across(axes.at(-1).x), up(top)];
}

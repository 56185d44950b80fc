// The settings of the picture: which indices, which axes, which colours.

import { byId, element, keyed, setText } from "./dom.js";
import { counted, digits, short, shortened } from "./format.js";
import { distanceTo } from "./metric.js";
import { newest } from "./overview_feed.js";
import { categories, rampPicture } from "./palette.js";
import { custom, projectionsOf } from "./projections.js";
import { COLOR_MODE } from "./shaders.js";

const CUSTOM = "custom";
// More edges hide the points behind them, so they are shown only when they are asked for.
const MAX_CLEAR_EDGES = 100_000;
// On a telephone, longer names would cover the picture.
const isNarrow = matchMedia("(max-width: 860px)");
const NARROW_NAME = 16;

/** The settings. They act on the picture at once. */
export class ViewPanel {
  #space = null;
  #projections = [];
  #probed = null;
  #isSizeChosen = false;
  #areEdgesChosen = false;
  #drawn = [];

  /** `viewChanged` is called when the picture draws other things than before. */
  constructor(picture, viewChanged) {
    this.picture = picture;
    this.viewChanged = viewChanged;
    byId("axes-preset").addEventListener("change", () => this.#chooseAxes());
    byId("axes-custom").addEventListener("change", () => this.#chooseAxes());
    byId("color-by").addEventListener("change", () => this.#chooseColor());
    for (const id of ["tag-bits", "tag-first"]) byId(id).addEventListener("change", () => this.#chooseColor());
    byId("point-size").addEventListener("input", () => {
      this.#isSizeChosen = true;
      this.#setSize(Number(byId("point-size").value));
    });
    byId("edges").addEventListener("change", () => {
      this.#areEdgesChosen = true;
      this.#setEdges(byId("edges").checked);
    });
    this.#showTagBits();
  }

  /** Lists all indices with a check mark at those that are shown. */
  setLayers(layers, drawn) {
    this.#drawn = drawn;
    const shown = layers.map((layer) => layer.name);
    const rows = [...shown, ...namesBeside(shown)].map((name) => {
      const layer = layers.find((one) => one.name === name);
      const index = newest?.indices.find((one) => one.name === name);
      const isOther = layer?.space && !drawn.includes(layer);
      const size = index && `${short(Number(index.pointCount))} point${Number(index.pointCount) === 1 ? "" : "s"}`;
      const about = isOther ? `another space, ${layer.space.text}` : [index?.space, size].filter(Boolean).join(" · ");
      return { name, layer, about, isOther };
    });
    keyed(byId("layers"), rows, (row) => row.name, (row) => this.#makeRow(row.name), updateRow);
    byId("revisions-about").hidden = drawn.length < 2;
    this.#updateEdges();
    if (!this.#isSizeChosen) this.#setSize(sizeFor(drawn));
    this.#showLegend();
  }

  /** Offers the projections of a space. The present choice stays if the space has it too. */
  setSpace(space) {
    if (this.#space?.text === space.text) return;
    this.#space = space;
    this.#probed = null;
    this.#projections = projectionsOf(space);
    const select = byId("axes-preset");
    const options = this.#projections.map(({ id, label }) => element("option", { value: id, text: label }));
    if (space.coordinateCount > 1) options.push(element("option", { value: CUSTOM, text: "choose coordinates…" }));
    select.replaceChildren(...options);
    const named = (name, value) => element("option", { value, text: name });
    const choices = () => [named("none", -1), ...space.names.map(named)];
    const axes = ["first", "second", "third"].map((which, axis) => {
      const choice = element("select", { "aria-label": `Coordinate of the ${which} axis` }, ...choices());
      choice.value = axis < space.coordinateCount ? axis : -1;
      return choice;
    });
    byId("axes-custom").replaceChildren(byId("axes-custom").querySelector("legend"), ...axes);
    this.#chooseAxes();
    this.#chooseColor();
  }

  /** The state that the probe asked about, for the colours by distance; null without one. */
  setProbed(state) {
    this.#probed = state;
    if (byId("color-by").value === "distance") this.#chooseColor();
  }

  #makeRow(name) {
    const box = element("input", { type: "checkbox" });
    box.addEventListener("change", () => {
      const shown = [...byId("layers").children].filter((row) => row.querySelector("input").checked).map((row) => row.dataset.key);
      // A picture of nothing is of no use: the last index stays.
      if (shown.length === 0) box.checked = true;
      else location.hash = `#/${shown.join(",")}`;
    });
    const label = element("label", {}, box, element("span", { class: "key" }), element("span", { class: "layer-name", text: name }));
    return element("li", {}, label, element("span", { class: "layer-about" }));
  }

  #chooseAxes() {
    const chosen = byId("axes-preset").value;
    byId("axes-custom").hidden = chosen !== CUSTOM;
    const coordinates = [...byId("axes-custom").querySelectorAll("select")].map((select) => Number(select.value));
    const projection = chosen === CUSTOM ? custom(this.#space, ...coordinates) : this.#projections.find(({ id }) => id === chosen);
    this.picture?.setProjection(projection);
    this.viewChanged();
  }

  #chooseColor() {
    const by = byId("color-by").value;
    const { first, bits } = tagRun();
    const none = () => () => 0;
    const colorings = {
      index: { mode: COLOR_MODE.flat, colorOf: none },
      age: { mode: COLOR_MODE.age, colorOf: none },
      tag: { mode: COLOR_MODE.category, colorOf: ({ tags }) => (slot) => bitsOf(tags[2 * slot], tags[2 * slot + 1], first, bits) },
      distance: this.#byDistance(),
    };
    this.picture?.setColoring(colorings[by]);
    this.#showTagBits();
    this.#showLegend();
  }

  #showTagBits() {
    const isHidden = byId("color-by").value !== "tag";
    byId("tag-run").hidden = isHidden;
    document.querySelector("label[for=tag-bits]").hidden = isHidden;
  }

  // The scale ends at the farthest point that is here when the colour is chosen; later points beyond it look like it.
  #byDistance() {
    if (!this.#probed) return { mode: COLOR_MODE.flat, colorOf: () => () => 0 };
    const distance = distanceTo(this.#space, this.#probed);
    let most = 0;
    for (const { cloud } of this.#drawn) {
      for (let slot = 0; slot < cloud.length; slot++) most = Math.max(most, distance(cloud.rows, slot * cloud.coordinateCount));
    }
    this.mostDistance = most;
    const scale = most > 0 ? 65535 / most : 0;
    // The near points are bright: the ramp runs from far to near.
    return {
      mode: COLOR_MODE.ramp,
      colorOf: ({ rows, coordinateCount }) => (slot) => Math.max(0, 65535 - distance(rows, slot * coordinateCount) * scale),
    };
  }

  #updateEdges() {
    const declaring = this.#drawn.filter(({ declaresEdges }) => declaresEdges);
    const edges = declaring.reduce((sum, { cloud }) => sum + (cloud.edges?.count ?? 0), 0);
    const isOne = this.#drawn.length < 2;
    let about = isOne ? "the index declares no edges" : "none of the indices declares edges";
    if (declaring.length > 0) about = counted(edges, "edge");
    byId("edges").disabled = declaring.length === 0;
    setText(byId("edges-about"), this.#drawn.length > 0 ? about : "");
    if (!this.#areEdgesChosen) this.#setEdges(declaring.length > 0 && edges <= MAX_CLEAR_EDGES);
  }

  #setEdges(areShown) {
    byId("edges").checked = areShown;
    if (!this.picture || this.picture.hasEdges === areShown) return;
    this.picture.hasEdges = areShown;
    this.picture.pacer.request();
  }

  #setSize(size) {
    byId("point-size").value = size;
    if (!this.picture || this.picture.pointSize === size) return;
    this.picture.pointSize = size;
    this.picture.pacer.request(true);
  }

  #showLegend() {
    const by = byId("color-by").value;
    const row = (color, text) => {
      const swatch = element("span", { class: "key" });
      swatch.style.background = color;
      return element("li", {}, swatch, text);
    };
    const scale = (from, to) => element("li", {}, element("span", { text: from }), rampPicture(), element("span", { text: to }));
    let rows = [];
    if (by === "index" && this.#drawn.length > 1) {
      rows = this.#drawn.map(({ color, name }) => row(color, isNarrow.matches ? shortened(name, NARROW_NAME) : name));
    }
    if (by === "age") rows = [scale("old", "new")];
    if (by === "tag") {
      const { bits } = tagRun();
      rows = Array.from({ length: 1 << bits }, (_, tag) => row(categories()[tag], tag.toString(2).padStart(bits, "0")));
    }
    if (by === "distance" && this.#probed) rows = [scale(`far, ${digits(this.mostDistance)}`, "near, 0")];
    if (by === "distance" && !this.#probed) rows = [element("li", { text: "probe a point first" })];
    byId("legend").replaceChildren(...rows);
  }
}

/** The run of tag bits that the colours show. */
function tagRun() {
  const first = Math.min(Math.max(Math.trunc(Number(byId("tag-first").value)) || 0, 0), 63);
  return { first, bits: Number(byId("tag-bits").value) };
}

/** `bits` bits of a tag from bit `first` on. A tag has 64 bits, in two halves; beyond them are zeros. */
export function bitsOf(low, high, first, bits) {
  const carried = first > 0 && first < 32 ? high << (32 - first) : 0;
  return (first < 32 ? (low >>> first) | carried : high >>> (first - 32)) & ((1 << bits) - 1);
}

/** The other indices: those that can join the picture first, and among them those that are named like one in it. */
function namesBeside(shown) {
  const all = newest?.indices ?? [];
  const space = all.find(({ name }) => name === shown[0])?.space;
  const others = all.filter(({ name }) => !shown.includes(name)).map((index) => ({
    name: index.name,
    isSame: index.space === space,
    likeness: Math.max(0, ...shown.map((name) => commonStart(name, index.name))),
  }));
  others.sort((a, b) => b.isSame - a.isSame || b.likeness - a.likeness || (a.name < b.name ? -1 : 1));
  return others.map(({ name }) => name);
}

function commonStart(a, b) {
  let length = 0;
  while (length < a.length && a[length] === b[length]) length += 1;
  return length;
}

function updateRow(row, { layer, about, isOther }) {
  const key = row.querySelector(".key");
  row.querySelector("input").checked = Boolean(layer);
  key.style.background = layer && !isOther ? layer.color : "";
  row.classList.toggle("other", Boolean(isOther));
  setText(row.querySelector(".layer-about"), about);
}

/** A size at which the number of points can be told apart. */
function sizeFor(layers) {
  const points = layers.reduce((sum, { cloud }) => sum + (cloud.length ?? 0), 0);
  const steps = [[500, 8], [5_000, 6], [30_000, 4], [150_000, 3], [400_000, 2]];
  return steps.find(([most]) => points <= most)?.[1] ?? 1.5;
}

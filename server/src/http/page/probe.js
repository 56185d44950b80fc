// The probe: a state whose neighbours the server is asked for.

import { serverForPrograms } from "./addresses.js";
import { call } from "./api.js";
import { showAnswer } from "./answer.js";
import { ALIVE } from "./cloud.js";
import { byId, element, setText } from "./dom.js";
import { count, digits, shortened } from "./format.js";

// The number of characters for which the list of indices has room.
const MAX_NAME = 20;

// The fields of a request and those of the form. A name that begins with another one stands before it.
const FIELDS = {
  "filter.tag_value": "probe-value",
  filter: "probe-mask",
  k: "probe-k",
  radius: "probe-radius",
  epsilon: "probe-epsilon",
  states: "probe-state",
};

/** The form of the probe. */
export class Probe {
  #layers = [];
  #all = [];
  // The index that the form is about, and its space.
  #uid = "";
  #space = "";
  // The revision of the shown answer, and the one that the picture shows; 0 while that is the newest.
  #answered = 0;
  #shown = 0;
  // The number of searches so far: a late answer of an older one is dropped.
  #searches = 0;

  constructor(picture, view) {
    this.picture = picture;
    this.view = view;
    byId("probe").addEventListener("submit", (event) => {
      event.preventDefault();
      this.run();
    });
    // Enter sends a state, as it does in the other fields.
    byId("probe-state").addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.shiftKey) return;
      event.preventDefault();
      this.run();
    });
    byId("probe-clear").addEventListener("click", () => this.clear());
    byId("look-closer").addEventListener("click", () => picture?.lookAtProbe());
    byId("look-at-all").addEventListener("click", () => picture?.lookAtAll());
    byId("neighbors").addEventListener("pointerover", (event) => picture?.setHighlight(event.target.closest("tr")?.sectionRowIndex ?? -1));
    byId("neighbors").addEventListener("pointerleave", () => picture?.setHighlight(-1));
    byId("probe-index").addEventListener("change", () => this.#choose());
  }

  /** The indices that can be asked, which are among `all`. */
  setLayers(layers, all) {
    const select = byId("probe-index");
    const chosen = select.value;
    this.#layers = layers;
    this.#all = all;
    select.replaceChildren(...layers.map(({ name }) => element("option", { value: name, title: name, text: shortened(name, MAX_NAME) })));
    if (layers.some(({ name }) => name === chosen)) select.value = chosen;
    const isOne = layers.length < 2;
    select.hidden = isOne;
    document.querySelector("label[for=probe-index]").hidden = isOne;
    this.#choose();
  }

  /** The picture shows another revision; 0 is the newest. */
  showRevision(revision) {
    this.#shown = revision;
    const isPast = revision > 0 && revision < this.#answered;
    byId("answer-past").hidden = !isPast;
    if (isPast) setText(byId("answer-past"), `The server searches the newest revision; the picture shows revision ${count(revision)}.`);
  }

  /** Probes a point of the picture. The picture has rounded coordinates, so the exact ones are asked for. */
  async probePoint(layer, slot) {
    byId("probe-index").value = layer.name;
    this.#choose();
    const search = ++this.#searches;
    const { cloud } = layer;
    let state = [...cloud.stateOf(slot)];
    // The server knows only where a point is now: one that was removed or replaced is probed where the picture has it.
    if (cloud.died[slot] === ALIVE) {
      try {
        const { points } = await call(layer.name, "get", { ids: [cloud.idOf(slot)], include: { with_states: true } });
        state = points.states[0];
      } catch {
        // The point may be gone meanwhile: its rounded state is still a state.
      }
      if (search !== this.#searches) return;
    }
    byId("probe-state").value = state.join(", ");
    await this.run();
  }

  /** Sends the search that the form has. */
  async run() {
    const search = ++this.#searches;
    this.#fail("");
    const layer = this.#layer;
    if (!layer) {
      const refusal = this.#all.map((one) => one.refusal).find(Boolean);
      return this.#fail(refusal || "The page still waits for the server to describe the index. Search again then.");
    }
    const question = readForm(layer.space, (field, problem) => this.#fail(problem, field));
    if (!question) return;
    byId("probe-run").disabled = true;
    try {
      const verb = question.k === undefined ? "query" : "knn";
      const [answer, server] = await Promise.all([call(layer.name, verb, bodyOf(question)), serverForPrograms()]);
      if (search !== this.#searches) return;
      const states = answer.states?.[0] ?? [];
      const labels = (answer.distances[0] ?? []).map((distance) => digits(Number(distance)));
      this.picture?.setMarks(question.state, states, labels);
      this.view.setProbed(question.state);
      showAnswer({ ...question, index: layer.name }, answer, server);
      this.#answered = Number(answer.revision.number);
      this.showRevision(this.#shown);
    } catch (error) {
      if (search !== this.#searches) return;
      const field = Object.keys(FIELDS).find((name) => error.field?.startsWith(name) || error.message.startsWith(name));
      this.#fail(error instanceof TypeError ? "The server is not connected. Try again when it is." : error.message, field);
    } finally {
      byId("probe-run").disabled = false;
    }
  }

  /** Takes the probe and its answer away. */
  clear() {
    this.#searches += 1;
    this.#fail("");
    this.#dropAnswer();
  }

  #dropAnswer() {
    byId("answer").hidden = true;
    this.picture?.setMarks(null);
    this.view.setProbed(null);
  }

  #fail(problem, field) {
    // An older answer is none to this search.
    if (problem) this.#dropAnswer();
    setText(byId("probe-error"), problem);
    for (const [name, id] of Object.entries(FIELDS)) {
      if (problem && name === field) byId(id).setAttribute("aria-invalid", "true");
      else byId(id).removeAttribute("aria-invalid");
    }
  }

  get #layer() {
    return this.#layers.find(({ name }) => name === byId("probe-index").value);
  }

  // An answer is about one index: another one has others, also if it was made again under the same name.
  #choose() {
    const layer = this.#layer;
    if (layer?.uidOfSpace !== this.#uid) this.clear();
    this.#uid = layer?.uidOfSpace;
    if (!layer) return;
    const { factors, names, text } = layer.space;
    if (text !== this.#space) byId("probe-state").value = "";
    this.#space = text;
    setText(byId("probe-names"), names.join(", "));
    byId("probe-state").placeholder = factors.flatMap(({ kind, size }) => (kind === "SO3" ? [0, 0, 0, 1] : Array(size).fill(0))).join(", ");
  }
}

/** The search in the form; undefined after `fail` was told which field holds no number. The server checks the rest. */
function readForm(space, fail) {
  const typed = byId("probe-state").value.trim() || byId("probe-state").placeholder;
  const state = [];
  for (const [i, text] of typed.split(/[\s,;]+/).filter(Boolean).entries()) {
    const number = numberOf(text);
    if (number === undefined) return void fail("states", `states[0].coords[${i}]: "${text}" is no number (${space.names[i] ?? "one too many"})`);
    state.push(number);
  }
  const question = { state };
  for (const name of ["k", "radius", "epsilon"]) {
    const text = byId(FIELDS[name]).value.trim();
    if (text === "") continue;
    question[name] = numberOf(text);
    if (question[name] === undefined) return void fail(name, `${name}: "${text}" is no number`);
  }
  const [mask, value] = ["probe-mask", "probe-value"].map((id) => integerOf(byId(id).value.trim() || "0"));
  if (mask === undefined || value === undefined) return void fail("filter", "filter: a tag is a whole number, decimal or after 0x");
  if (mask !== 0n || value !== 0n) question.tag = { mask, value };
  if (question.k === undefined && question.radius === undefined) return void fail("k", "k: give k, a radius, or both");
  return question;
}

function numberOf(text) {
  if (/^[+-]?(inf|infinity)$/i.test(text)) return text.startsWith("-") ? -Infinity : Infinity;
  if (/^nan$/i.test(text)) return NaN;
  const number = Number(text);
  return Number.isNaN(number) ? undefined : number;
}

function integerOf(text) {
  return /^(0x[0-9a-f]+|\d+)$/i.test(text) ? BigInt(text) : undefined;
}

/** The body of the request. Numbers that JSON cannot hold are texts. */
function bodyOf({ state, k, radius, epsilon, tag }) {
  const json = (number) => (Number.isFinite(number) ? number : String(number));
  const body = { states: [state.map(json)], include: { with_states: true, with_tags: true } };
  if (k !== undefined) body.k = json(k);
  if (radius !== undefined) body.radius = json(radius);
  if (epsilon !== undefined) body.epsilon = json(epsilon);
  if (tag) body.filter = { tag_mask: String(tag.mask), tag_value: String(tag.value) };
  return body;
}

// The slider over the revisions, and the replay of how the points came.

import { ALIVE } from "./cloud.js";
import { byId, setText } from "./dom.js";
import { about, count, counted } from "./format.js";

const REPLAY_MS = 10_000;

/** The slider. At its right end it follows the newest revision. */
export class Timeline {
  /** True while the newest revision is shown. */
  isLive = true;
  #replay = 0;
  // The past that is still to be loaded.
  #queue = [];

  /** `layers()` are those of the picture. `shown` is called when another revision is shown. */
  constructor(layers, picture, shown) {
    this.shown = shown;
    this.layers = layers;
    this.picture = picture;
    this.slider = byId("slider");
    // A hand on the slider asks for the past, which takes a moment.
    for (const touch of ["pointerdown", "focus"]) this.slider.addEventListener(touch, () => this.#loadPast());
    this.slider.addEventListener("input", () => {
      this.#loadPast();
      this.#stop();
      this.#goTo(Number(this.slider.value));
    });
    byId("play").addEventListener("click", () => (this.#replay ? this.#stop() : this.#play()));
    byId("live").addEventListener("click", () => this.goLive());
  }

  /** Follows the newest revision. */
  goLive() {
    this.#stop();
    this.#goTo(this.newest);
  }

  /** The newest revision of any index in the picture. */
  get newest() {
    return Math.max(0, ...this.#clouds().map((cloud) => cloud.newest));
  }

  /** The revision that the picture shows. */
  get revision() {
    return this.isLive ? this.newest : Number(this.slider.value);
  }

  /** Brings the slider up to date with the points. */
  update() {
    const { newest, slider } = this;
    this.#loadNext();
    slider.max = newest;
    if (this.isLive) slider.value = newest;
    else if (this.picture) this.picture.revision = Number(slider.value);
    this.#show();
  }

  #clouds() {
    return this.layers().map((layer) => layer.cloud).filter((cloud) => cloud.length !== undefined);
  }

  #loadPast() {
    this.#queue = this.layers().map((layer) => layer.past);
    this.#loadNext();
    this.#show();
  }

  // One after the other: each takes a connection, of which a browser has few.
  #loadNext() {
    while (this.#queue.length > 0 && this.layers().every((layer) => layer.past.loaded === 1)) this.#queue.shift().load();
  }

  // The part of the past that is loaded.
  get #loaded() {
    const parts = this.layers().map(({ past }) => (this.#queue.includes(past) ? 0 : past.loaded));
    return parts.length > 0 ? parts.reduce((sum, part) => sum + part, 0) / parts.length : 1;
  }

  #goTo(revision) {
    this.isLive = revision >= this.newest;
    this.slider.value = revision;
    if (this.picture) {
      this.picture.revision = this.isLive ? ALIVE - 1 : revision;
      this.picture.pacer.request(true);
    }
    this.#show();
  }

  #show() {
    const { revision } = this;
    const clouds = this.#clouds();
    const total = (countOf) => clouds.reduce((sum, cloud) => sum + countOf(cloud), 0);
    const shown = total((cloud) => cloud.countAt(revision));
    const points = counted(shown, "point");
    const isWhole = clouds.every((cloud) => cloud.share.isWhole);
    const all = isWhole ? points : `${about(total((cloud) => cloud.estimateAt(revision)))} points (${count(shown)} of the sample)`;
    const words = `revision ${count(revision)}: ${all}`;
    const lost = total((cloud) => cloud.lostAt(revision));
    const notes = [
      lost > 0 && `${count(lost)} not drawn: the log tells only that they were there`,
      clouds.some((cloud) => revision < cloud.knownFrom) && this.#loaded === 1 && "without points that were removed since, which are not known",
      this.#loaded < 1 && `reading the log, ${Math.floor(100 * this.#loaded)} %`,
    ].filter(Boolean);
    setText(byId("revision"), words);
    setText(byId("revision-notes"), notes.join(" · "));
    setText(byId("count"), points);
    this.slider.setAttribute("aria-valuetext", [words, ...notes].join(", "));
    this.shown();
    byId("live").setAttribute("aria-pressed", String(this.isLive));
  }

  #play() {
    this.#loadPast();
    const from = this.isLive ? Number(this.slider.min) : Number(this.slider.value);
    const whole = Math.max(this.newest - Number(this.slider.min), 1);
    let began = performance.now();
    this.#label("pause", "Pause");
    const step = (now) => {
      // The replay begins with what was.
      if (this.#loaded < 1) began = now;
      const revision = Math.floor(from + (whole * Math.max(now - began, 0)) / REPLAY_MS);
      if (revision >= this.newest) {
        this.#stop();
        this.#goTo(this.newest);
        return;
      }
      this.#replay = requestAnimationFrame(step);
      this.#goTo(revision);
    };
    this.#replay = requestAnimationFrame(step);
  }

  #stop() {
    cancelAnimationFrame(this.#replay);
    this.#replay = 0;
    this.#label("play", "Replay how the points came");
  }

  #label(sign, words) {
    byId("play").dataset.sign = sign;
    byId("play").setAttribute("aria-label", words);
  }
}

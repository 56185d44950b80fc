// The pauses between attempts, which grow.

const FIRST_PAUSE_MS = 250;
const MAX_PAUSE_MS = 5000;

/** Pauses from a quarter of a second to five seconds. */
export class Pauses {
  #pause = FIRST_PAUSE_MS;
  #wake = () => {};

  /** Begins from the first pause again. */
  reset() {
    this.#pause = FIRST_PAUSE_MS;
  }

  /** Waits for the next pause, or until `end` is called. */
  next() {
    const pause = this.#pause;
    this.#pause = Math.min(2 * pause, MAX_PAUSE_MS);
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, pause);
      this.#wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  /** Ends the present pause. */
  end() {
    this.#wake();
  }
}

// Takes the binary stream of points apart: frames of a JSON head and a body of columns, all little-endian.

const LENGTHS_BYTES = 8;
// No server sends larger frames; more means that the stream is not what it should be.
const MAX_FRAME_BYTES = 1 << 28;

/** Collects bytes as they arrive and hands on each frame that is complete: its head, and its body as an ArrayBuffer. */
export class FrameReader {
  #lengths = new Uint8Array(LENGTHS_BYTES);
  #head = null;
  #body = null;
  #filled = 0;

  constructor(receive) {
    this.receive = receive;
  }

  push(bytes) {
    let at = 0;
    // A frame without a body is complete without another byte, so the loop also turns where none are left.
    for (;;) {
      const target = this.#target();
      const taken = Math.min(target.length - this.#filled, bytes.length - at);
      target.set(bytes.subarray(at, at + taken), this.#filled);
      at += taken;
      this.#filled += taken;
      if (this.#filled < target.length) return;
      this.#filled = 0;
      this.#advance();
    }
  }

  #target() {
    return this.#body ?? this.#head ?? this.#lengths;
  }

  // Each buffer is filled once: the head after the lengths, and the body after the head.
  #advance() {
    if (this.#body) {
      const head = JSON.parse(new TextDecoder().decode(this.#head));
      const body = this.#body.buffer;
      this.#head = this.#body = null;
      this.receive(head, body);
    } else if (this.#head) {
      this.#body = new Uint8Array(new DataView(this.#lengths.buffer).getUint32(4, true));
    } else {
      const lengths = new DataView(this.#lengths.buffer);
      const [head, body] = [lengths.getUint32(0, true), lengths.getUint32(4, true)];
      if (head + body > MAX_FRAME_BYTES) throw new Error(`a frame of ${head + body} bytes`);
      this.#head = new Uint8Array(head);
    }
  }
}

/** The columns of a `points` frame. Ids, revisions and tags are pairs of 32 bits, the low one first. */
export function pointColumns({ row_count: rows }, body, coordinateCount) {
  return {
    ids: new Uint32Array(body, 0, 2 * rows),
    revisions: new Uint32Array(body, 8 * rows, 2 * rows),
    tags: new Uint32Array(body, 16 * rows, 2 * rows),
    coordinates: new Float32Array(body, 24 * rows, coordinateCount * rows),
  };
}

/** The ids of a `removed` or a `replaced` frame. */
export function idsOf({ row_count: rows }, body) {
  return new Uint32Array(body, 0, 2 * rows);
}

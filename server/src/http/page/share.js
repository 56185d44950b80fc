// The even sample of an index: the points whose hashed id (XXH3 of its eight bytes) is at most a limit. The server samples by
// the same rule, so the page can tell which points belong to a smaller share without asking.

// The constants of XXH3 for inputs of eight bytes without a seed, each as its high and its low half.
const KEY = [0xc73ab174, 0xc5ecd5a2];
const FACTOR = [0x9fb21c65, 0x1e98df25];
const INPUT_BYTES = 8;

const RANGE = 2 ** 32;

/** The ids of a share of all points, from 0 to 1. Ids are pairs of 32 bits. */
export class Share {
  #high;
  #low;

  constructor(fraction) {
    this.fraction = fraction;
    this.#high = Math.floor(fraction * RANGE);
    this.#low = Math.floor((fraction * RANGE - this.#high) * RANGE);
  }

  get isWhole() {
    return this.fraction >= 1;
  }

  /** True if the sample includes the point with this id. */
  has(low, high) {
    if (this.fraction >= 1) return true;
    hash(low >>> 0, high >>> 0);
    return hashed[0] < this.#high || (hashed[0] === this.#high && hashed[1] <= this.#low);
  }
}

// The result of `hash` and of `multiply`, high half first: a million calls make no garbage.
const hashed = [0, 0];

function hash(low, high) {
  // The halves of the input change places.
  const a = low ^ KEY[0];
  const b = high ^ KEY[1];
  // x ^= rotl(x, 49) ^ rotl(x, 24)
  const x = a ^ ((b << 17) | (a >>> 15)) ^ ((a << 24) | (b >>> 8));
  const y = b ^ ((a << 17) | (b >>> 15)) ^ ((b << 24) | (a >>> 8));
  multiply(x, y);
  // x ^= (x >> 35) + 8, whose sum needs no carry: a shifted number has 29 bits.
  multiply(hashed[0], hashed[1] ^ ((hashed[0] >>> 3) + INPUT_BYTES));
  // x ^= x >> 28
  const [top, bottom] = hashed;
  hashed[0] = (top ^ (top >>> 28)) >>> 0;
  hashed[1] = (bottom ^ ((bottom >>> 28) | (top << 4))) >>> 0;
}

// The low 64 bits of the product with the factor.
function multiply(high, low) {
  const [l0, l1] = [low & 0xffff, low >>> 16];
  const [f0, f1] = [FACTOR[1] & 0xffff, FACTOR[1] >>> 16];
  const first = l0 * f0;
  const middle = l1 * f0 + (first >>> 16);
  const other = l0 * f1 + (middle & 0xffff);
  const carry = l1 * f1 + Math.floor(middle / 0x10000) + Math.floor(other / 0x10000);
  hashed[0] = ((carry | 0) + Math.imul(high, FACTOR[1]) + Math.imul(low, FACTOR[0])) >>> 0;
  hashed[1] = ((other << 16) | (first & 0xffff)) >>> 0;
}

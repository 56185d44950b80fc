// Reads the text of a space, such as `R3*SO3:0.15` or `sum(R2, SO2:0.5)`, into its factors and its metric.
//
// The server sends spaces in a form that it has checked, so a text that cannot be read is no error here: the page falls
// back to bare coordinates.

/**
 * The space of a text: `groups` of weighted factors, `factors` in the order of the row, and the `names` of the
 * coordinates. A factor has `kind` ("R", "SO2" or "SO3"), `at` (its first coordinate), `size`, and `weight`.
 */
export function parseSpace(text, coordinateCount) {
  let groups;
  try {
    groups = new Parser(text).space();
  } catch {
    groups = [{ weight: 1, terms: [{ kind: "R", size: coordinateCount, weight: 1 }] }];
  }
  let at = 0;
  const factors = [];
  for (const group of groups) {
    group.terms = group.terms.map((term) => ({ ...term, at: (at += term.size) - term.size }));
    factors.push(...group.terms);
  }
  if (at !== coordinateCount) return parseSpace("?", coordinateCount);
  const names = coordinateNames(factors);
  return { text, coordinateCount, groups, factors, names, axes: axesOf(factors, names) };
}

/**
 * The axis of each coordinate: its name with the unit, and the range of its canonical form; of a number of R there is neither.
 */
function axesOf(factors, names) {
  return factors.flatMap(({ kind, at, size, period }) =>
    Array.from({ length: size }, (_, i) => {
      const name = names[at + i];
      if (kind === "SO2") return { name: period === 2 * Math.PI ? `${name} (rad)` : name, range: [-period / 2, period / 2] };
      if (kind === "R") return { name, range: null };
      // A quaternion and its negative are one rotation; the server stores the one with w ≥ 0.
      return { name, range: i === 3 ? [0, 1] : [-1, 1] };
    }),
  );
}

/** The names that the server's errors and the command line use: x, y, z, theta, qx, …, numbered if a kind repeats. */
function coordinateNames(factors) {
  const total = (kind) => factors.filter((factor) => factor.kind === kind).length;
  const seen = { R: 0, SO2: 0, SO3: 0 };
  return factors.flatMap(({ kind, size }) => {
    const number = seen[kind]++;
    const which = total(kind) > 1 ? String(number) : "";
    if (kind === "SO2") return [`theta${which}`];
    if (kind === "SO3") return ["qx", "qy", "qz", "qw"].map((part) => part + which);
    if (size <= 3) return ["x", "y", "z"].slice(0, size).map((axis) => axis + which);
    return Array.from({ length: size }, (_, i) => `x${which}${which && "_"}${i}`);
  });
}

/** A parser by recursive descent. The grammar stands in docs/spaces.md. */
class Parser {
  constructor(text) {
    this.tokens = text.match(/[A-Za-z]+\d*|[\d.]+(?:[eE][+-]?\d+)?|[()[\],*:^]/g) ?? [];
    this.at = 0;
  }

  space() {
    const groups = this.eat("sum") ? this.sum() : [{ weight: 1, terms: flat(this.product()) }];
    if (this.at < this.tokens.length) throw new Error(this.tokens[this.at]);
    return groups;
  }

  sum() {
    const groups = [];
    this.require("(");
    do {
      const items = this.product();
      // One item makes a group of its weight as often as its count says; several make one group.
      if (items.length > 1) groups.push({ weight: 1, terms: flat(items) });
      else for (let i = 0; i < items[0].count; i++) groups.push({ weight: items[0].weight, terms: items[0].terms });
    } while (this.eat(","));
    this.require(")");
    return groups;
  }

  product() {
    const items = [this.item()];
    while (this.eat("*")) items.push(this.item());
    return items;
  }

  item() {
    let terms;
    if (this.eat("(")) {
      terms = flat(this.product());
      this.require(")");
    } else {
      terms = [this.factor()];
    }
    const weight = this.eat(":") ? this.number() : 1;
    const count = this.eat("^") ? this.number() : 1;
    return { terms, weight, count };
  }

  factor() {
    const word = this.tokens[this.at++] ?? "";
    if (word === "SO3" || word === "RP3") return { kind: "SO3", size: 4, weight: 1 };
    if (word === "SO2" || word === "S1") {
      let period = 2 * Math.PI;
      if (this.eat("[")) {
        period = this.number();
        this.require("]");
      }
      return { kind: "SO2", size: 1, weight: 1, period };
    }
    const real = /^R(\d+)$/.exec(word);
    if (!real) throw new Error(word);
    return { kind: "R", size: Number(real[1]), weight: 1 };
  }

  number() {
    const number = Number(this.tokens[this.at++]);
    if (!Number.isFinite(number)) throw new Error("number");
    return number;
  }

  require(token) {
    if (!this.eat(token)) throw new Error(token);
  }

  eat(token) {
    const found = this.tokens[this.at] === token;
    if (found) this.at += 1;
    return found;
  }
}

/** The terms of a product: the weight of a parenthesised item multiplies those of its factors. */
function flat(items) {
  return items.flatMap(({ terms, weight, count }) =>
    Array.from({ length: count }, () => terms.map((term) => ({ ...term, weight: term.weight * weight }))).flat(),
  );
}

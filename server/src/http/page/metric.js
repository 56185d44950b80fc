// The distance of a space, to colour points by it. The server's answers come from its own arithmetic; this one need only
// be near enough for a colour.

/** A function of a row of coordinates, at an offset, that gives its distance to `state`. */
export function distanceTo(space, state) {
  return (coordinates, offset) => {
    let sum = 0;
    for (const group of space.groups) {
      let squares = 0;
      for (const term of group.terms) {
        const distance = factorDistance(term, state, coordinates, offset);
        squares += term.weight * distance * distance;
      }
      sum += group.weight * Math.sqrt(squares);
    }
    return sum;
  };
}

function factorDistance({ kind, at, size, period }, state, coordinates, offset) {
  if (kind === "SO2") {
    const apart = Math.abs(state[at] - coordinates[offset + at]) % period;
    return Math.min(apart, period - apart);
  }
  let sum = 0;
  if (kind === "SO3") {
    for (let i = at; i < at + 4; i++) sum += state[i] * coordinates[offset + i];
    return Math.acos(Math.min(1, Math.abs(sum)));
  }
  for (let i = at; i < at + size; i++) {
    const apart = state[i] - coordinates[offset + i];
    sum += apart * apart;
  }
  return Math.sqrt(sum);
}

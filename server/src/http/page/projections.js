// The ways to draw a state of a space as a point of three dimensions.
//
// A projection has a `label` and `axes`, the names of its three axes; `null` is an axis without a meaning. `fit` takes the
// bounds of the coordinates (`low` and `high`, one number each) and returns the `ranges` of the three axes, the `unit`
// of each (axes of one unit share their scale), and `project(coordinates, offset, out)`. `isNumbered` is false for the
// axes that show no quantity of their own. `wraps` is true for those whose ends are the same place.

/**
 * The projections of a space, the best first. The last ones are good for every space. One that has `isParallel` in the place of
 * axes and `fit` draws points as lines through one axis for each coordinate.
 */
export function projectionsOf(space) {
  const { factors, names } = space;
  const of = (kind) => factors.filter((factor) => factor.kind === kind);
  const [vectors, angles, rotations] = [of("R"), of("SO2"), of("SO3")];
  const numbered = (all, i) => (all.length > 1 ? ` ${i}` : "");
  const found = [];
  // Joints have no picture of their own, and no three of them are the best.
  const areJoints = names.length > 3 && rotations.length === 0 && !vectors.some(({ size }) => size === 2 || size === 3);
  if (areJoints) found.push(parallel(space));
  const add = (id, label, projection) => found.push({ id, label, ...projection });
  vectors.forEach((vector, i) => {
    const position = `position${numbered(vectors, i)}`;
    const { at } = vector;
    if (vector.size === 3) add(`r3-${i}`, position, straight(space, at, at + 1, at + 2));
    const angle = angles[Math.min(i, angles.length - 1)];
    if (vector.size === 2 && angle) {
      add(`r2-angle-${i}`, `${position}, angle upwards`, straight(space, at, at + 1, angle.at));
      add(`r2-ring-${i}`, `${position}, angle around a ring`, ring(space, at, at + 1, angle));
    }
    if (vector.size === 2) add(`flat-${i}`, `${position}, flat`, straight(space, at, at + 1, -1));
  });
  if (vectors.length === 2 && vectors.every((vector) => vector.size === 2)) {
    add("two", "both positions", straight(space, vectors[0].at, vectors[0].at + 1, vectors[1].at));
  }
  if (angles.length > 2) add("angles", "three angles", straight(space, angles[0].at, angles[1].at, angles[2].at));
  if (angles.length > 1) add("torus", "two angles on a torus", torus(space, angles[0], angles[1]));
  if (angles.length > 0) add("circle", "angle on a circle", circle(space, angles[0]));
  rotations.forEach((rotation, i) => {
    const which = numbered(rotations, i);
    add(`so3-${i}`, `rotation${which}, as a vector`, ball(rotation, which));
  });
  if (names.length > 3 || found.length === 0 || vectors.some(({ size }) => size === 1)) {
    const [x, y, z] = [0, 1, 2].map((i) => (i < names.length ? i : -1));
    add("first", names.length > 3 ? "first three coordinates" : "coordinates", straight(space, x, y, z));
  }
  if (!areJoints && names.length > 1) found.push(parallel(space));
  return found;
}

function parallel(space) {
  return { id: "parallel", label: "parallel coordinates", isParallel: true, space };
}

/** Any three coordinates, by number; −1 leaves an axis flat. */
export function custom(space, x, y, z) {
  return { id: "custom", label: "chosen coordinates", ...straight(space, x, y, z) };
}

function straight(space, ...chosen) {
  const factorOf = (coordinate) => space.factors.find(({ at, size }) => coordinate >= at && coordinate < at + size);
  return {
    axes: chosen.map((coordinate) => (coordinate < 0 ? null : space.axes[coordinate].name)),
    isNumbered: [true, true, true],
    fit({ low, high }) {
      const ranges = chosen.map((coordinate) => {
        if (coordinate < 0) return [0, 0];
        return space.axes[coordinate].range ?? [low[coordinate], high[coordinate]];
      });
      // Angles have a scale of their own; so have coordinates of different factors, whose units may differ.
      const units = chosen.map((coordinate) => (coordinate < 0 ? -1 : factorOf(coordinate).at));
      const [x, y, z] = chosen;
      const project = (coordinates, offset, out) => {
        out[0] = x < 0 ? 0 : coordinates[offset + x];
        out[1] = y < 0 ? 0 : coordinates[offset + y];
        out[2] = z < 0 ? 0 : coordinates[offset + z];
      };
      const wraps = chosen.map((coordinate) => coordinate >= 0 && factorOf(coordinate).kind === "SO2");
      return { ranges, units, wraps, project };
    },
  };
}

/** The ball of rotation vectors: the axis of the rotation times its angle, at most π. */
function ball({ at }, which) {
  return {
    axes: ["x", "y", "z"].map((axis) => `rotation${which} ${axis} (rad)`),
    isNumbered: [true, true, true],
    fit: () => ({
      ranges: [[-Math.PI, Math.PI], [-Math.PI, Math.PI], [-Math.PI, Math.PI]],
      units: [0, 0, 0],
      // Opposite places of the sphere around the ball are the same rotation.
      wraps: [true, true, true],
      project(coordinates, offset, out) {
        const from = offset + at;
        const [x, y, z, w] = [coordinates[from], coordinates[from + 1], coordinates[from + 2], coordinates[from + 3]];
        const sine = Math.sqrt(x * x + y * y + z * z);
        // Near no rotation the vector is 2 (x, y, z). A canonical quaternion has w ≥ 0, one that is typed may not.
        const scale = sine < 1e-9 ? 2 : (Math.sign(w || 1) * 2 * Math.atan2(sine, Math.abs(w))) / sine;
        out[0] = scale * x;
        out[1] = scale * y;
        out[2] = scale * z;
      },
    }),
  };
}

function circle(space, { at, period }) {
  const name = space.names[at];
  return {
    axes: [`cos ${name}`, `sin ${name}`, null],
    isNumbered: [true, true, true],
    fit: () => ({
      ranges: [[-1, 1], [-1, 1], [0, 0]],
      units: [0, 0, 0],
      wraps: [false, false, false],
      project(coordinates, offset, out) {
        const angle = ((2 * Math.PI) / period) * coordinates[offset + at];
        out[0] = Math.cos(angle);
        out[1] = Math.sin(angle);
        out[2] = 0;
      },
    }),
  };
}

/** Two angles on a torus, whose tube is a third of its ring. */
function torus(space, long, short) {
  const tube = 1 / 3;
  return {
    axes: [`${space.names[long.at]} around the ring`, null, `${space.names[short.at]} around the tube`],
    isNumbered: [false, false, false],
    fit: () => ({
      ranges: [[-1 - tube, 1 + tube], [-1 - tube, 1 + tube], [-tube, tube]],
      units: [0, 0, 0],
      wraps: [false, false, false],
      project(coordinates, offset, out) {
        const around = ((2 * Math.PI) / long.period) * coordinates[offset + long.at];
        const tilt = ((2 * Math.PI) / short.period) * coordinates[offset + short.at];
        const radius = 1 + tube * Math.cos(tilt);
        out[0] = radius * Math.cos(around);
        out[1] = radius * Math.sin(around);
        out[2] = tube * Math.sin(tilt);
      },
    }),
  };
}

/** The plane of x and y turned about an axis beside it by the angle, so that both ends of the angle meet. */
function ring(space, x, y, { at, period }) {
  return {
    axes: [`${space.names[at]} around the ring, ${space.names[x]} outwards`, null, space.names[y]],
    isNumbered: [false, false, true],
    fit({ low, high }) {
      const width = high[x] - low[x] || 1;
      // The hole is as wide as the plane, so that the inner side is not crowded.
      const most = 1.5 * width;
      return {
        ranges: [[-most, most], [-most, most], [low[y], high[y]]],
        units: [0, 0, 0],
        wraps: [false, false, false],
        project(coordinates, offset, out) {
          const radius = 0.5 * width + coordinates[offset + x] - low[x];
          const angle = ((2 * Math.PI) / period) * coordinates[offset + at];
          out[0] = radius * Math.cos(angle);
          out[1] = radius * Math.sin(angle);
          out[2] = coordinates[offset + y];
        },
      };
    },
  };
}

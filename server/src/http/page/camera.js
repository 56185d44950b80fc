// A camera that turns about a target. The third axis of the picture points up.

const FIELD_OF_VIEW = 0.62;
const MAX_PITCH = Math.PI / 2;
const ZOOM = { least: 0.15, most: 400 };
// The share of the canvas that the box takes; the rest is for numbers and names.
const FILLED = 0.78;

/** The camera: where it stands, and the matrix that it gives. */
export class Camera {
  constructor() {
    this.aspect = 1;
    this.reset();
  }

  /** Looks at the whole box; from above if it is flat. */
  reset(box = [1, 1, 1]) {
    const flat = box[2] === 0;
    this.yaw = flat ? -Math.PI / 2 : -0.95;
    this.pitch = flat ? MAX_PITCH : 0.5;
    this.home = Math.hypot(...box) / 2;
    this.target = [0, 0, 0];
    // True once a person moved the camera, which is then left alone.
    this.isMoved = false;
    this.zoom = 1;
    this.#fill(box);
  }

  // Comes as near as the corners of the box allow, which is nearer than the sphere around it for a long box.
  #fill(box) {
    const signs = [-1, 1];
    const corners = signs.flatMap((x) => signs.flatMap((y) => signs.map((z) => [(x * box[0]) / 2, (y * box[1]) / 2, (z * box[2]) / 2])));
    for (let round = 0; round < 4; round++) {
      const matrix = this.matrix();
      const places = corners.map((corner) => onScreen(matrix, corner, 2, 2)).filter(Boolean);
      const most = Math.max(...places.flatMap(([x, y]) => [Math.abs(x - 1), Math.abs(y - 1)]));
      this.zoom *= FILLED / most;
    }
  }

  /** Looks at a place, so that a ball about it takes most of the picture. */
  lookAt(place, radius) {
    this.isMoved = true;
    this.target = [...place];
    const distance = radius / (FILLED * Math.tan(FIELD_OF_VIEW / 2) * Math.min(1, this.aspect));
    this.zoom = clamp((this.zoom * this.distance) / distance, ZOOM.least, ZOOM.most);
  }

  /** The distance of the eye from the target. A narrow canvas needs a greater one. */
  get distance() {
    const fit = this.home / Math.sin(FIELD_OF_VIEW / 2) / Math.min(1, this.aspect);
    return (1.02 * fit) / this.zoom;
  }

  turn(yaw, pitch) {
    this.isMoved = true;
    this.yaw -= yaw;
    this.pitch = clamp(this.pitch + pitch, -MAX_PITCH, MAX_PITCH);
  }

  zoomBy(factor) {
    this.isMoved = true;
    this.zoom = clamp(this.zoom * factor, ZOOM.least, ZOOM.most);
  }

  /** Moves the target by a share of the height of the picture, to the right and up. */
  pan(right, up) {
    this.isMoved = true;
    const { x, y } = this.#frame();
    const scale = 2 * this.distance * Math.tan(FIELD_OF_VIEW / 2);
    this.target = this.target.map((at, i) => clamp(at - scale * (right * x[i] + up * y[i]), -2, 2));
  }

  /** The place of the eye. */
  eye() {
    const { z } = this.#frame();
    return this.target.map((at, i) => at + this.distance * z[i]);
  }

  /** The product of projection and view, column by column. */
  matrix() {
    const { x, y, z } = this.#frame();
    const eye = this.eye();
    const focal = 1 / Math.tan(FIELD_OF_VIEW / 2);
    // Depth is resolved best between planes that enclose the box closely.
    const near = Math.max(this.distance - 2.5 * this.home, this.distance * 0.02);
    const far = this.distance + 2.5 * this.home + 2;
    const depth = [(near + far) / (near - far), (2 * near * far) / (near - far)];
    const along = (axis) => -(axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2]);
    const rows = [
      [...x.map((part) => (part * focal) / this.aspect), (along(x) * focal) / this.aspect],
      [...y.map((part) => part * focal), along(y) * focal],
      [...z.map((part) => part * depth[0]), along(z) * depth[0] + depth[1]],
      [...z.map((part) => -part), -along(z)],
    ];
    const matrix = new Float32Array(16);
    for (let row = 0; row < 4; row++) for (let column = 0; column < 4; column++) matrix[4 * column + row] = rows[row][column];
    return matrix;
  }

  // The right, the up and the backward direction of the eye.
  #frame() {
    const [cosYaw, sinYaw] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    const [cosPitch, sinPitch] = [Math.cos(this.pitch), Math.sin(this.pitch)];
    return {
      x: [-sinYaw, cosYaw, 0],
      y: [-sinPitch * cosYaw, -sinPitch * sinYaw, cosPitch],
      z: [cosPitch * cosYaw, cosPitch * sinYaw, sinPitch],
    };
  }
}

/** The place on the canvas of a point, in CSS pixels; null behind the eye. */
export function onScreen(matrix, [x, y, z], width, height) {
  const w = matrix[3] * x + matrix[7] * y + matrix[11] * z + matrix[15];
  if (w <= 0) return null;
  const right = matrix[0] * x + matrix[4] * y + matrix[8] * z + matrix[12];
  const up = matrix[1] * x + matrix[5] * y + matrix[9] * z + matrix[13];
  return [(width * (1 + right / w)) / 2, (height * (1 - up / w)) / 2];
}

function clamp(number, least, most) {
  return Math.min(Math.max(number, least), most);
}

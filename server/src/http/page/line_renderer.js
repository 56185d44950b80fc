// Draws points as lines through parallel axes with WebGL2: one instance for each point, and one vertex for each axis.

import { link, uniformsOf } from "./program.js";
import { COLOR_MODE } from "./shaders.js";

/** The bytes of a line without its values: the revisions of birth and death, and a colour. */
export const LINE_BYTES = 12;
/** The width of the texture of values, and the most rows: every WebGL2 has these. */
export const TEXTURE_WIDTH = 2048;

const VERTEX_SHADER = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
in uvec3 a_line;
uniform sampler2D u_values;
uniform sampler2D u_palette;
uniform vec4 u_frame;
uniform int u_axes;
uniform int u_step;
uniform uint u_revision;
uniform int u_mode;
uniform vec3 u_color;
uniform float u_age;
uniform float u_alpha;
flat out vec4 v_color;

void main() {
  // All vertices of a line that is not there at this revision go to the same place, where nothing is drawn.
  if (a_line.x > u_revision || u_revision >= a_line.y) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    v_color = vec4(0.0);
    return;
  }
  int at = gl_InstanceID * u_step * u_axes + gl_VertexID;
  float value = texelFetch(u_values, ivec2(at % ${TEXTURE_WIDTH}, at / ${TEXTURE_WIDTH}), 0).r;
  float along = float(gl_VertexID) / float(u_axes - 1);
  gl_Position = vec4(mix(u_frame.x, u_frame.z, along), mix(u_frame.y, u_frame.w, value), 0.0, 1.0);
  vec3 color = u_color;
  if (u_mode == ${COLOR_MODE.category}) {
    color = texelFetch(u_palette, ivec2(int(a_line.z & 255u), 1), 0).rgb;
  } else if (u_mode != ${COLOR_MODE.flat}) {
    float share = u_mode == ${COLOR_MODE.age} ? float(a_line.x) * u_age : float(a_line.z) / 65535.0;
    color = texelFetch(u_palette, ivec2(int(clamp(share, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
  }
  v_color = vec4(color * u_alpha, u_alpha);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
flat in vec4 v_color;
out vec4 color;
void main() {
  color = v_color;
}`;

const UNIFORMS = [
  "u_values", "u_palette", "u_frame", "u_axes", "u_step", "u_revision", "u_mode", "u_color", "u_age", "u_alpha",
];

/** The lines on the canvas of another renderer, whose palette they share. */
export class LineRenderer {
  #buffers = new Map();

  constructor(renderer) {
    this.renderer = renderer;
    this.prepare();
  }

  /** Makes the program, at first and after the graphics processor has lost everything. */
  prepare() {
    const { gl } = this.renderer;
    this.#buffers.clear();
    this.program = link(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    this.places = uniformsOf(gl, this.program, UNIFORMS);
    this.line = gl.getAttribLocation(this.program, "a_line");
  }

  /** Sends the lines of a layer: `lines` has three numbers of 32 bits a line, and `values` whole rows of the texture. */
  upload(layer, lines, values) {
    const { gl } = this.renderer;
    const buffers = this.#buffers.get(layer) ?? { array: gl.createVertexArray(), lines: gl.createBuffer(), values: gl.createTexture() };
    this.#buffers.set(layer, buffers);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.lines);
    gl.bufferData(gl.ARRAY_BUFFER, lines, gl.DYNAMIC_DRAW);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, buffers.values);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, TEXTURE_WIDTH, values.length / TEXTURE_WIDTH, 0, gl.RED, gl.FLOAT, values);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.activeTexture(gl.TEXTURE0);
  }

  /** Draws each `thinning`-th of a layer's `count` lines. `frame` is left, bottom, right and top of the axes, from −1 to 1. */
  draw(layer, count, thinning, { frame, axes, revision, mode, color, age, alpha }) {
    const { gl } = this.renderer;
    const buffers = this.#buffers.get(layer);
    if (!buffers || count === 0) return;
    const { places } = this;
    gl.useProgram(this.program);
    gl.bindVertexArray(buffers.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.lines);
    gl.enableVertexAttribArray(this.line);
    gl.vertexAttribIPointer(this.line, 3, gl.UNSIGNED_INT, LINE_BYTES * thinning, 0);
    gl.vertexAttribDivisor(this.line, 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, buffers.values);
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform1i(places.u_values, 1);
    gl.uniform1i(places.u_palette, 0);
    gl.uniform4fv(places.u_frame, frame);
    gl.uniform1i(places.u_axes, axes);
    gl.uniform1i(places.u_step, thinning);
    gl.uniform1ui(places.u_revision, revision);
    gl.uniform1i(places.u_mode, mode);
    gl.uniform3fv(places.u_color, color);
    gl.uniform1f(places.u_age, age);
    gl.uniform1f(places.u_alpha, alpha);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.LINE_STRIP, 0, axes, Math.floor((count - 1) / thinning) + 1);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.bindVertexArray(null);
  }

  /** Frees the buffers of a layer. */
  drop(layer) {
    const { gl } = this.renderer;
    const buffers = this.#buffers.get(layer);
    if (!buffers) return;
    gl.deleteVertexArray(buffers.array);
    gl.deleteBuffer(buffers.lines);
    gl.deleteTexture(buffers.values);
    this.#buffers.delete(layer);
  }
}

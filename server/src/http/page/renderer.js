// Draws the vertices with WebGL2: one draw call for the points of each index, and one for its edges.

import { background, categoryTable, ramp } from "./palette.js";
import { link, uniformsOf } from "./program.js";
import { FRAGMENT_SHADER, VERTEX_SHADER } from "./shaders.js";
import { VERTEX_BYTES } from "./vertices.js";

// WebGL allows a stride of at most 255 bytes, so at least each fifteenth vertex is drawn.
export const MAX_THINNING = 15;

/** The points on a canvas. */
export class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    const options = { alpha: true, antialias: false, depth: true, powerPreference: "high-performance" };
    this.gl = canvas.getContext("webgl2", options);
    if (!this.gl) throw new Error("This browser has no WebGL2, which the picture needs. The overview works without it.");
    this.buffers = new Map();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.#restore());
    this.#prepare();
  }

  /** Called after the graphics processor has lost everything and is back. */
  onRestored = () => {};

  /** Makes the palette anew, after a change of the theme. */
  setPalette() {
    const { gl } = this;
    const colors = new Uint8Array(4 * 512);
    colors.set(ramp());
    colors.set(categoryTable(), 4 * 256);
    gl.bindTexture(gl.TEXTURE_2D, this.palette);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 2, 0, gl.RGBA, gl.UNSIGNED_BYTE, colors);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    this.background = background();
  }

  /** Sends the vertices [from, to) of a layer. A layer whose vertices outgrow its buffer is sent whole. */
  upload(layer, vertices, from, to) {
    const { gl } = this;
    const buffer = this.buffers.get(layer) ?? { buffer: gl.createBuffer(), capacity: 0 };
    this.buffers.set(layer, buffer);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer.buffer);
    if (buffer.capacity < vertices.length) {
      buffer.capacity = vertices.capacity;
      gl.bufferData(gl.ARRAY_BUFFER, VERTEX_BYTES * buffer.capacity, gl.DYNAMIC_DRAW);
      [from, to] = [0, vertices.length];
    }
    if (from < to) gl.bufferSubData(gl.ARRAY_BUFFER, VERTEX_BYTES * from, vertices.bytes(from, to));
  }

  /** Adds ends of a layer's edges, pairs of vertices, to those that were sent before, or replaces them. */
  addEdges(layer, ends, isReplacing) {
    const { gl } = this;
    const buffer = this.buffers.get(layer);
    if (!buffer) return;
    buffer.edges ??= { buffer: gl.createBuffer(), capacity: 0, length: 0 };
    const { edges } = buffer;
    if (isReplacing) edges.length = 0;
    const length = edges.length + ends.length;
    if (length > edges.capacity) {
      const larger = gl.createBuffer();
      edges.capacity = Math.max(2 * edges.capacity, length, 4096);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, larger);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, 4 * edges.capacity, gl.DYNAMIC_DRAW);
      if (edges.length > 0) {
        gl.bindBuffer(gl.COPY_READ_BUFFER, edges.buffer);
        gl.copyBufferSubData(gl.COPY_READ_BUFFER, gl.ELEMENT_ARRAY_BUFFER, 0, 0, 4 * edges.length);
      }
      gl.deleteBuffer(edges.buffer);
      edges.buffer = larger;
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, edges.buffer);
    gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 4 * edges.length, ends);
    edges.length = length;
  }

  /** Frees the buffers of a layer. */
  drop(layer) {
    this.gl.deleteBuffer(this.buffers.get(layer)?.buffer ?? null);
    this.gl.deleteBuffer(this.buffers.get(layer)?.edges?.buffer ?? null);
    this.buffers.delete(layer);
  }

  /** Begins a picture of the size of the canvas on the screen. */
  begin(width, height) {
    const { gl, canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Draws each `thinning`-th of a layer's first `count` vertices, and as large a part of its edges. */
  draw(layer, count, thinning, { view, box, revision, mode, color, ages, size, distance, hasEdges }) {
    const { gl, places } = this;
    const buffer = this.buffers.get(layer);
    if (!buffer || count === 0) return;
    gl.useProgram(this.program);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer.buffer);
    this.#point(VERTEX_BYTES * thinning);
    gl.uniformMatrix4fv(places.u_view, false, view);
    gl.uniform3fv(places.u_box, box);
    gl.uniform1ui(places.u_revision, revision);
    gl.uniform1i(places.u_mode, mode);
    gl.uniform3fv(places.u_color, color);
    gl.uniform2fv(places.u_ages, ages);
    gl.uniform3fv(places.u_background, this.background);
    gl.uniform1f(places.u_size, size);
    gl.uniform1f(places.u_distance, distance);
    gl.uniform1i(places.u_isEdge, 0);
    gl.drawArrays(gl.POINTS, 0, Math.floor((count - 1) / thinning) + 1);
    const ends = hasEdges && buffer.edges ? 2 * Math.floor(buffer.edges.length / 2 / thinning) : 0;
    if (ends === 0) return;
    // The ends are numbers of vertices, so here none is left out.
    this.#point(VERTEX_BYTES);
    gl.uniform1i(places.u_isEdge, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer.edges.buffer);
    gl.drawElements(gl.LINES, ends, gl.UNSIGNED_INT, 0);
  }

  #point(stride) {
    const { gl, attributes } = this;
    gl.vertexAttribPointer(attributes.place, 3, gl.UNSIGNED_SHORT, true, stride, 0);
    gl.vertexAttribPointer(attributes.color, 1, gl.UNSIGNED_SHORT, true, stride, 6);
    gl.vertexAttribIPointer(attributes.life, 2, gl.UNSIGNED_INT, stride, 8);
  }

  #prepare() {
    const { gl } = this;
    const program = link(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    this.program = program;
    gl.useProgram(program);
    const attribute = (name) => gl.getAttribLocation(program, name);
    this.attributes = { place: attribute("a_place"), color: attribute("a_color"), life: attribute("a_life") };
    for (const at of Object.values(this.attributes)) gl.enableVertexAttribArray(at);
    const names = ["u_view", "u_box", "u_revision", "u_mode", "u_color", "u_ages", "u_background", "u_size", "u_distance", "u_isEdge"];
    this.places = uniformsOf(gl, program, names);
    gl.enable(gl.DEPTH_TEST);
    this.palette = gl.createTexture();
    this.setPalette();
  }

  #restore() {
    this.buffers.clear();
    this.#prepare();
    this.onRestored();
  }
}

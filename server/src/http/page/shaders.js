// The two shaders of the points.

/** How a vertex gets its colour. */
export const COLOR_MODE = { flat: 0, ramp: 1, category: 2, age: 3 };

export const VERTEX_SHADER = `#version 300 es
precision highp float;
precision highp int;
in vec3 a_place;
in float a_color;
in uvec2 a_life;
uniform mat4 u_view;
uniform vec3 u_box;
uniform uint u_revision;
uniform int u_mode;
uniform vec3 u_color;
uniform vec2 u_ages;
uniform vec3 u_background;
uniform float u_size;
uniform float u_distance;
uniform sampler2D u_palette;
uniform bool u_isEdge;
flat out vec4 v_color;
out float v_life;

void main() {
  // A point that is not there at this revision goes where nothing is drawn.
  bool isThere = a_life.x <= u_revision && u_revision < a_life.y;
  // An edge is there if both of its ends are: elsewhere this is below 1.
  v_life = isThere ? 1.0 : 0.0;
  if (!isThere && !u_isEdge) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 0.0;
    v_color = vec4(0.0);
    return;
  }
  gl_Position = u_view * vec4((a_place - 0.5) * u_box, 1.0);
  float nearness = u_distance / max(gl_Position.w, 0.01);
  gl_PointSize = max(1.0, u_size * clamp(nearness, 0.6, 3.0));
  vec3 color = u_color;
  if (u_mode == ${COLOR_MODE.category}) {
    color = texelFetch(u_palette, ivec2(int(a_color * 65535.0 + 0.5) & 255, 1), 0).rgb;
  } else if (u_mode != ${COLOR_MODE.flat}) {
    float share = u_mode == ${COLOR_MODE.age} ? (float(a_life.x) - u_ages.x) * u_ages.y : a_color;
    color = texelFetch(u_palette, ivec2(int(clamp(share, 0.0, 1.0) * 255.0 + 0.5), 0), 0).rgb;
  }
  // Farther points fade into the background, which shows depth without light.
  float far = clamp((gl_Position.w - u_distance) * 0.55 + 0.22, 0.0, 0.62);
  // Edges are paler than points, so that they do not hide them.
  if (u_isEdge) far = 0.45 + 0.55 * far;
  v_color = vec4(mix(color, u_background, far), u_isEdge ? 0.0 : gl_PointSize);
}`;

export const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
flat in vec4 v_color;
in float v_life;
out vec4 color;

void main() {
  if (v_life < 0.999) discard;
  vec3 shade = v_color.rgb;
  // A disc shows from about three pixels on; smaller points are squares, which cost less.
  if (v_color.a > 2.5) {
    vec2 from = gl_PointCoord * 2.0 - 1.0;
    float square = dot(from, from);
    if (square > 1.0) discard;
    shade *= 1.0 - 0.28 * square;
  }
  color = vec4(shade, 1.0);
}`;

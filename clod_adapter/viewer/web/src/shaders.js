// What the GPU runs. The conventions are those of clod_adapter/_kernels: pixel centres at +0.5, a blur of 0.3 px^2,
// the ray clamped to 0.15 of the picture beyond its edges, alpha at most 0.999 and dropped below 1/255.
import attenuation from "./attenuation.glsl";

/** Of each Gaussian as many texels of 8 halves as its higher bands take. */
export const BAND_TEXELS = [0, 2, 3, 6, 9];

const SH = `
const float C[8] = float[](0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
  -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154);
void basis(vec3 d, out float b[24]) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  b[0] = -C[0] * y; b[1] = C[0] * z; b[2] = -C[0] * x;
#if DEGREE > 1
  b[3] = C[1] * xy; b[4] = -C[1] * yz; b[5] = C[2] * (2.0 * zz - xx - yy); b[6] = -C[1] * xz; b[7] = C[3] * (xx - yy);
#endif
#if DEGREE > 2
  float four = 4.0 * zz - xx - yy;
  b[8] = C[4] * y * (3.0 * xx - yy); b[9] = C[5] * xy * z; b[10] = C[6] * y * four;
  b[11] = C[7] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy); b[12] = C[6] * x * four;
  b[13] = 0.5 * C[5] * z * (xx - yy); b[14] = C[4] * x * (xx - 3.0 * yy);
#endif
#if DEGREE > 3
  float seven = 7.0 * zz - 1.0, less = 7.0 * zz - 3.0, w = -1.7701307697799304, u = -0.6690465435572892;
  b[15] = 2.5033429417967046 * xy * (xx - yy); b[16] = w * yz * (3.0 * xx - yy);
  b[17] = 0.9461746957575601 * xy * seven; b[18] = u * yz * less;
  b[19] = 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0); b[20] = u * xz * less;
  b[21] = 0.47308734787878004 * (xx - yy) * seven; b[22] = w * xz * (xx - 3.0 * yy);
  b[23] = 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
#endif
}
float half_of(uvec4 texel, int k) {
  vec2 pair = unpackHalf2x16(texel[k >> 1]);
  return (k & 1) == 0 ? pair.x : pair.y;
}
vec3 bands(int row, vec3 direction) {
  float b[24];
  basis(direction, b);
  vec3 sum = vec3(0.0);
  uvec4 texel;
  for (int k = 0; k < 3 * COUNT; k++) {
    if ((k & 7) == 0) texel = texelFetch(higher, place(row * TEXELS + (k >> 3)), 0);
    sum[k % 3] += b[k / 3] * half_of(texel, k & 7);
  }
  return sum;
}`;

/** Projects one Gaussian; its outputs are captured as a buffer, an instance of the second program each. */
export const projectVertex = (degree) => `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
#define DEGREE ${degree}
#define COUNT ${(degree + 1) ** 2 - 1}
#define TEXELS ${BAND_TEXELS[degree]}
layout(location = 0) in uint row;
uniform sampler2D records;   // per Gaussian: mean, opacity; unit quaternion wxyz; scales, sigma_d; colour at band 0
uniform usampler2D higher;
uniform mat3 view;           // world to camera, OpenCV axes
uniform vec3 eye;
uniform vec4 pinhole;        // fx, fy, cx, cy
uniform vec3 size;           // width, height, near
uniform bool dialled, soft;
uniform float dial, distance_unit, eps, tau;
out vec2 centre; out vec3 conic; out vec3 axes; out vec4 color;

ivec2 place(int at) { return ivec2(at & ${4096 - 1}, at >> 12); }
${attenuation}
${degree ? SH : ""}
mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}
void main() {
  centre = vec2(-1e4); conic = vec3(0.0); axes = vec3(0.0); color = vec4(0.0);
  int at = int(row) * 4;
  vec4 mean = texelFetch(records, place(at), 0), shape = texelFetch(records, place(at + 2), 0);
  vec3 ray = mean.xyz - eye, point = view * ray;
  if (!(point.z >= size.z)) return;
  float opacity = mean.w;
  if (dialled) opacity = clodOpacity(opacity, shape.w, length(ray) / distance_unit, dial, eps, tau, soft);
  if (opacity < 1.0 / 255.0) return;

  vec2 margin = 0.15 * size.xy / pinhole.xy;
  vec2 slope = clamp(point.xy / point.z, -pinhole.zw / pinhole.xy - margin, (size.xy - pinhole.zw) / pinhole.xy + margin);
  vec3 right = vec3(view[0].x, view[1].x, view[2].x), down = vec3(view[0].y, view[1].y, view[2].y);
  vec3 forward = vec3(view[0].z, view[1].z, view[2].z);
  mat3 turned = rotation(texelFetch(records, place(at + 1), 0));
  vec3 p = pinhole.x / point.z * ((right - slope.x * forward) * turned) * shape.xyz;
  vec3 q = pinhole.y / point.z * ((down - slope.y * forward) * turned) * shape.xyz;
  float xx = dot(p, p), yy = dot(q, q), xy = dot(p, q);
  vec3 c = cross(p, q);
  float det = dot(c, c) + 0.3 * (xx + yy) + 0.09;   // a sum of squares: exact even for needles
  xx += 0.3; yy += 0.3;
  if (!(det < 3e38)) return;

  float half_gap = length(vec2(0.5 * (xx - yy), xy));
  float major = 0.5 * (xx + yy) + half_gap, minor = det / major;
  vec2 along = half_gap < 1e-6 ? vec2(1.0, 0.0) : xx > yy ? vec2(major - yy, xy) : vec2(xy, major - xx);
  float reach = sqrt(2.0 * log(255.0 * opacity)) + 0.01;
  axes = vec3(reach * sqrt(major) * normalize(along), reach * sqrt(minor));
  centre = pinhole.xy * point.xy / point.z + pinhole.zw;
  if (any(lessThan(centre + vec2(reach * sqrt(vec2(xx, yy))), vec2(0.0)))
    || any(greaterThan(centre - vec2(reach * sqrt(vec2(xx, yy))), size.xy))) { axes = vec3(0.0); return; }
  conic = vec3(yy, -xy, xx) / det;
  vec3 rgb = texelFetch(records, place(at + 3), 0).rgb;
  ${degree ? "rgb += bands(int(row), normalize(ray));" : ""}
  color = vec4(max(rgb, 0.0), opacity);
}`;

export const PROJECTED = ["centre", "conic", "axes", "color"];

export const nothing = `#version 300 es
precision mediump float;
void main() {}`;

export const splatVertex = `#version 300 es
precision highp float;
layout(location = 0) in vec2 centre;
layout(location = 1) in vec3 conic;
layout(location = 2) in vec3 axes;
layout(location = 3) in vec4 color;
uniform vec3 size;
flat out vec2 middle; flat out vec3 form; flat out vec4 paint;
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 side = length(axes.xy) > 0.0 ? normalize(axes.xy) : vec2(0.0);
  vec2 at = (centre + corner.x * axes.xy + corner.y * axes.z * vec2(-side.y, side.x)) / size.xy;
  gl_Position = vec4(at.x * 2.0 - 1.0, 1.0 - at.y * 2.0, 0.0, 1.0);
  middle = vec2(centre.x, size.y - centre.y);
  form = vec3(conic.x, -conic.y, conic.z); // the GPU counts rows from below
  paint = color;
}`;

// The exponent is taken from the pixel's own place: what a quad's corners are rounded to does not matter then.
export const splatFragment = `#version 300 es
precision highp float;
flat in vec2 middle; flat in vec3 form; flat in vec4 paint;
out vec4 result;
void main() {
  vec2 d = gl_FragCoord.xy - middle;
  float alpha = min(paint.a * exp(-0.5 * (form.x * d.x * d.x + form.z * d.y * d.y) - form.y * d.x * d.y), 0.999);
  if (!(alpha >= 1.0 / 255.0)) discard;
  result = vec4(paint.rgb * alpha, alpha);
}`;

export const copyVertex = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

export const copyFragment = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
out vec4 result;
void main() { result = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

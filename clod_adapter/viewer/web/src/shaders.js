// The shaders. Conventions as in clod_adapter/_kernels: pixel centres at +0.5, the model's screen-space filter, the ray
// clamped to 0.15 of the image beyond its edges, alpha at most 0.999 and discarded below 1/255.
import attenuation from "../../../integrations/shaders/attenuation.glsl";
import { WIDTH } from "./gpu.js";

/** By SH degree: texels per Gaussian, of 8 float16 values each, for the coefficients of degrees 1 and up. */
export const SH_TEXELS = [0, 2, 3, 6, 9];

// The harmonics of degrees 1 and up, in the order and signs of 3DGS, as in clod_adapter/_kernels/colors.py.
const TERMS = [
  "-0.4886025119029199 * y", "0.4886025119029199 * z", "-0.4886025119029199 * x",
  "1.0925484305920792 * xy", "-1.0925484305920792 * yz", "0.31539156525252005 * (2.0 * zz - xx - yy)",
  "-1.0925484305920792 * xz", "0.5462742152960396 * (xx - yy)",
  "-0.5900435899266435 * y * (3.0 * xx - yy)", "2.890611442640554 * xy * z", "-0.4570457994644658 * y * zz4",
  "0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)", "-0.4570457994644658 * x * zz4",
  "1.445305721320277 * z * (xx - yy)", "-0.5900435899266435 * x * (xx - 3.0 * yy)",
  "2.5033429417967046 * xy * (xx - yy)", "-1.7701307697799304 * yz * (3.0 * xx - yy)", "0.9461746957575601 * xy * zz7m1",
  "-0.6690465435572892 * yz * zz7m3", "0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0)", "-0.6690465435572892 * xz * zz7m3",
  "0.47308734787878004 * (xx - yy) * zz7m1", "-1.7701307697799304 * xz * (xx - 3.0 * yy)",
  "0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))",
];

/** Source of `shColor(row, direction)`, unrolled: compilers take seconds for the same with loops and arrays. */
function shSource(degree) {
  const lines = [], count = (degree + 1) ** 2 - 1, value = (j) => `h${j >> 1}.${"xy"[j & 1]}`;
  for (let t = 0; t < SH_TEXELS[degree]; t++) {
    lines.push(`uvec4 t${t} = texelFetch(sh, texelAt(row * ${SH_TEXELS[degree]} + ${t}), 0);`);
    for (let k = 0; k < 4; k++) lines.push(`vec2 h${4 * t + k} = unpackHalf2x16(t${t}.${"xyzw"[k]});`);
  }
  for (let k = 0; k < count; k++) {
    lines.push(`sum += (${TERMS[k]}) * vec3(${[0, 1, 2].map((c) => value(3 * k + c)).join(", ")});`);
  }
  return `vec3 shColor(int row, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  float zz4 = 4.0 * zz - xx - yy, zz7m1 = 7.0 * zz - 1.0, zz7m3 = 7.0 * zz - 3.0;
  vec3 sum = vec3(0.0);
  ${lines.join("\n")}
  return sum;
}`;
}

/** Projects the Gaussians, one per pixel, in drawing order; a Gaussian that is not drawn has zeros. */
export const projectFragment = (degree) => `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform usampler2D order;    // row of the file of each pixel
uniform int drawn;
uniform sampler2D records;   // per Gaussian: mean, opacity; unit quaternion wxyz; scales, sigma_d; colour of degree 0, growth_d
uniform usampler2D sh;       // coefficients of degrees 1 and up
uniform mat3 view;           // world to camera, OpenCV axes
uniform vec3 eye;
uniform vec4 pinhole;        // fx, fy, cx, cy
uniform vec3 size;           // width, height, near
uniform bool attenuated;
uniform float dial, distance_unit, start, near_distance;
uniform float blur;          // px^2 that the screen-space filter adds to covariances
uniform bool compensate;     // whether opacities are scaled by the ratio of the areas without and with the filter
// Bits of floats, because every WebGL2 device renders to integers. footprint: centre, major half-axis; conic: conic, length
// of the minor half-axis; color: colour, opacity.
layout(location = 0) out uvec4 footprint; layout(location = 1) out uvec4 conic; layout(location = 2) out uvec4 color;

ivec2 texelAt(int index) { return ivec2(index % ${WIDTH}, index / ${WIDTH}); }
${attenuation}
${degree ? shSource(degree) : ""}
vec3 unrotated(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) - q.x * v); }
void main() {
  footprint = conic = color = uvec4(0);
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  if (pixel.y * ${WIDTH} + pixel.x >= drawn) return;
  int row = int(texelFetch(order, pixel, 0).r), record = row * 4;
  vec4 mean = texelFetch(records, texelAt(record), 0), shape = texelFetch(records, texelAt(record + 2), 0);
  vec3 ray = mean.xyz - eye, point = view * ray;
  if (!(point.z >= size.z)) return;
  float opacity = mean.w, distance = length(ray) / distance_unit;
  if (attenuated) opacity = clodOpacity(opacity, shape.w, distance, dial, near_distance);
  vec4 tint = texelFetch(records, texelAt(record + 3), 0);
  if (attenuated) shape.xyz *= clodScale(tint.a, distance, dial, start);

  vec2 margin = 0.15 * size.xy / pinhole.xy;
  vec2 slope = clamp(point.xy / point.z, -pinhole.zw / pinhole.xy - margin, (size.xy - pinhole.zw) / pinhole.xy + margin);
  vec4 q = texelFetch(records, texelAt(record + 1), 0);
  vec3 u = pinhole.x / point.z * unrotated(q, vec3(1.0, 0.0, -slope.x) * view) * shape.xyz;   // of rows of the view
  vec3 v = pinhole.y / point.z * unrotated(q, vec3(0.0, 1.0, -slope.y) * view) * shape.xyz;
  float xx = dot(u, u), yy = dot(v, v), xy = dot(u, v);
  vec3 c = cross(u, v);
  float area = dot(c, c), det = area + blur * (xx + yy) + blur * blur;   // sums of squares: accurate for needles too
  xx += blur; yy += blur;
  if (!(det < 3e38)) return;
  if (compensate) opacity *= sqrt(area / det);
  if (opacity < 1.0 / 255.0) return;

  float half_difference = length(vec2(0.5 * (xx - yy), xy));
  float major = 0.5 * (xx + yy) + half_difference, minor = det / major;
  vec2 direction = half_difference < 1e-6 ? vec2(1.0, 0.0) : xx > yy ? vec2(major - yy, xy) : vec2(xy, major - xx);
  float radius = sqrt(2.0 * log(255.0 * opacity)) + 0.01;   // in standard deviations, to alpha 1/255
  vec2 centre = pinhole.xy * point.xy / point.z + pinhole.zw;
  vec2 extent = radius * sqrt(vec2(xx, yy));
  if (any(lessThan(centre + extent, vec2(0.0))) || any(greaterThan(centre - extent, size.xy))) return;
  vec3 rgb = tint.rgb;
  ${degree ? "rgb += shColor(row, normalize(ray));" : ""}
  float far = length(abs(centre - 0.5 * size.xy) + 0.5 * size.xy);   // to the farthest corner: no quad need be longer
  footprint = floatBitsToUint(vec4(centre, min(radius * sqrt(major), far) * normalize(direction)));
  conic = floatBitsToUint(vec4(vec3(yy, -xy, xx) / det, min(radius * sqrt(minor), far)));
  color = floatBitsToUint(vec4(max(rgb, 0.0), opacity));
}`;

export const splatVertex = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D footprint, conic, color;
uniform vec2 size;
flat out vec2 centre; flat out vec3 form; flat out vec4 rgba;
void main() {
  int row = gl_VertexID / 6, k = gl_VertexID % 6;   // two triangles, of the corners 0 1 2 and 3 2 1
  ivec2 texel = ivec2(row % ${WIDTH}, row / ${WIDTH}), at = ivec2(k < 3 ? k : 6 - k);
  vec4 a = uintBitsToFloat(texelFetch(footprint, texel, 0)), b = uintBitsToFloat(texelFetch(conic, texel, 0));
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);
  if (!(b.w > 0.0)) return;
  rgba = uintBitsToFloat(texelFetch(color, texel, 0));
  vec2 corner = vec2(at & ivec2(1, 2)) * vec2(2.0, 1.0) - 1.0, minor = normalize(a.zw) * b.w;
  vec2 position = (a.xy + corner.x * a.zw + corner.y * vec2(-minor.y, minor.x)) / size.xy;
  gl_Position = vec4(position.x * 2.0 - 1.0, 1.0 - position.y * 2.0, 0.0, 1.0);
  centre = vec2(a.x, size.y - a.y);
  form = vec3(b.x, -b.y, b.z); // rows of gl_FragCoord count from the bottom
}`;

// The exponent is computed from gl_FragCoord, so that the rounding of the quad's corners has no effect.
export const splatFragment = `#version 300 es
precision highp float;
flat in vec2 centre; flat in vec3 form; flat in vec4 rgba;
out vec4 result;
void main() {
  vec2 d = gl_FragCoord.xy - centre;
  float alpha = min(rgba.a * exp(-0.5 * (form.x * d.x * d.x + form.z * d.y * d.y) - form.y * d.x * d.y), 0.999);
  if (!(alpha >= 1.0 / 255.0)) discard;
  result = vec4(rgba.rgb * alpha, alpha);
}`;

export const copyVertex = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

export const copyFragment = `#version 300 es
precision highp float;
uniform highp sampler2D image;
out vec4 result;
void main() { result = vec4(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

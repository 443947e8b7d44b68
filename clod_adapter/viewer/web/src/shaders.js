// What the GPU runs. The conventions are those of clod_adapter/_kernels: pixel centres at +0.5, the model's screen-space filter,
// the ray clamped to 0.15 of the picture beyond its edges, alpha at most 0.999 and dropped below 1/255.
import attenuation from "../../../integrations/shaders/attenuation.glsl";
import { WIDTH } from "./gpu.js";

/** Of each Gaussian as many texels of 8 halves as its higher bands take. */
export const BAND_TEXELS = [0, 2, 3, 6, 9];

const BASIS = `
vec3 bands(int row, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  float four = 4.0 * zz - xx - yy, seven = 7.0 * zz - 1.0, less = 7.0 * zz - 3.0;
  vec3 sum = vec3(0.0);`;

// The higher bands in the order and signs of 3DGS, as clod_adapter/_kernels/sh.py has them.
const TERMS = [
  "-0.4886025119029199 * y", "0.4886025119029199 * z", "-0.4886025119029199 * x",
  "1.0925484305920792 * xy", "-1.0925484305920792 * yz", "0.31539156525252005 * (2.0 * zz - xx - yy)",
  "-1.0925484305920792 * xz", "0.5462742152960396 * (xx - yy)",
  "-0.5900435899266435 * y * (3.0 * xx - yy)", "2.890611442640554 * xy * z", "-0.4570457994644658 * y * four",
  "0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)", "-0.4570457994644658 * x * four",
  "1.445305721320277 * z * (xx - yy)", "-0.5900435899266435 * x * (xx - 3.0 * yy)",
  "2.5033429417967046 * xy * (xx - yy)", "-1.7701307697799304 * yz * (3.0 * xx - yy)", "0.9461746957575601 * xy * seven",
  "-0.6690465435572892 * yz * less", "0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0)", "-0.6690465435572892 * xz * less",
  "0.47308734787878004 * (xx - yy) * seven", "-1.7701307697799304 * xz * (xx - 3.0 * yy)",
  "0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy))",
];

/** `bands(row, direction)`, written out term by term: compilers take seconds over the same with loops and arrays. */
function bandsSource(degree) {
  const lines = [], count = (degree + 1) ** 2 - 1, value = (j) => `h${j >> 1}.${"xy"[j & 1]}`;
  for (let t = 0; t < BAND_TEXELS[degree]; t++) {
    lines.push(`uvec4 t${t} = texelFetch(higher, place(row * ${BAND_TEXELS[degree]} + ${t}), 0);`);
    for (let k = 0; k < 4; k++) lines.push(`vec2 h${4 * t + k} = unpackHalf2x16(t${t}.${"xyzw"[k]});`);
  }
  for (let k = 0; k < count; k++) {
    lines.push(`sum += (${TERMS[k]}) * vec3(${[0, 1, 2].map((c) => value(3 * k + c)).join(", ")});`);
  }
  return `${BASIS}\n${lines.join("\n")}\nreturn sum;\n}`;
}

/** Projects the Gaussians, a pixel each, in the order they are drawn in; all zero where nothing is to be drawn. */
export const projectFragment = (degree) => `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
uniform usampler2D order;    // the row of the file for each pixel
uniform int drawn;
uniform sampler2D records;   // per Gaussian: mean, opacity; unit quaternion wxyz; scales, sigma_d; colour at band 0
uniform usampler2D higher;
uniform mat3 view;           // world to camera, OpenCV axes
uniform vec3 eye;
uniform vec4 pinhole;        // fx, fy, cx, cy
uniform vec3 size;           // width, height, near
uniform bool dialled, soft;
uniform float dial, distance_unit, eps, tau;
uniform float blur;          // px^2 that the screen-space filter adds to covariances
uniform bool compensate;     // and whether opacities are scaled by how much that widens them
// As bits, which every WebGL2 can draw into: centre, major half-axis; conic, length of the minor one; colour, opacity.
layout(location = 0) out uvec4 first; layout(location = 1) out uvec4 second; layout(location = 2) out uvec4 third;

ivec2 place(int at) { return ivec2(at % ${WIDTH}, at / ${WIDTH}); }
${attenuation}
${degree ? bandsSource(degree) : ""}
mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}
void main() {
  first = second = third = uvec4(0);
  ivec2 here = ivec2(gl_FragCoord.xy);
  if (here.y * ${WIDTH} + here.x >= drawn) return;
  int row = int(texelFetch(order, here, 0).r), at = row * 4;
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
  float area = dot(c, c), det = area + blur * (xx + yy) + blur * blur;   // sums of squares: exact even for needles
  xx += blur; yy += blur;
  if (!(det < 3e38)) return;
  if (compensate) opacity *= sqrt(area / det);
  if (opacity < 1.0 / 255.0) return;

  float half_gap = length(vec2(0.5 * (xx - yy), xy));
  float major = 0.5 * (xx + yy) + half_gap, minor = det / major;
  vec2 along = half_gap < 1e-6 ? vec2(1.0, 0.0) : xx > yy ? vec2(major - yy, xy) : vec2(xy, major - xx);
  float reach = sqrt(2.0 * log(255.0 * opacity)) + 0.01;
  vec2 centre = pinhole.xy * point.xy / point.z + pinhole.zw;
  vec2 extent = reach * sqrt(vec2(xx, yy));
  if (any(lessThan(centre + extent, vec2(0.0))) || any(greaterThan(centre - extent, size.xy))) return;
  vec3 rgb = texelFetch(records, place(at + 3), 0).rgb;
  ${degree ? "rgb += bands(row, normalize(ray));" : ""}
  first = floatBitsToUint(vec4(centre, reach * sqrt(major) * normalize(along)));
  second = floatBitsToUint(vec4(vec3(yy, -xy, xx) / det, reach * sqrt(minor)));
  third = floatBitsToUint(vec4(max(rgb, 0.0), opacity));
}`;

export const splatVertex = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D first, second, third;
uniform vec3 size;
flat out vec2 middle; flat out vec3 form; flat out vec4 paint;
void main() {
  ivec2 here = ivec2(gl_VertexID >> 2, gl_InstanceID);
  vec4 a = uintBitsToFloat(texelFetch(first, here, 0)), b = uintBitsToFloat(texelFetch(second, here, 0));
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);
  if (!(b.w > 0.0)) return;
  paint = uintBitsToFloat(texelFetch(third, here, 0));
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0, across = normalize(a.zw) * b.w;
  vec2 at = (a.xy + corner.x * a.zw + corner.y * vec2(-across.y, across.x)) / size.xy;
  gl_Position = vec4(at.x * 2.0 - 1.0, 1.0 - at.y * 2.0, 0.0, 1.0);
  middle = vec2(a.x, size.y - a.y);
  form = vec3(b.x, -b.y, b.z); // the GPU counts rows from below
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

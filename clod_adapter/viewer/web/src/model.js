// A splat on the GPU, and the worker that culls and sorts its Gaussians.
import { wholeCount } from "../../../../viewers/equation.js";
import { WIDTH, dataTexture } from "./gpu.js";
import { SH_TEXELS } from "./shaders.js";
import { add, cross, dot, scaled, unit } from "./vector.js";

const SH_C0 = 0.28209479177387814;
const VISIBLE = 3.4; // standard deviations to alpha 1/255
const UPS = [[0, -1, 0], [0, 0, 1]]; // of COLMAP, whose y axis points down, and of tools with z up
const FLAT = Math.log(2); // a flat Gaussian's least scale is at most half the next one
const BESIDE = Math.cos(Math.PI / 5), SURE = 0.3; // share of the flat ones beside the axis, by chance 0.19

export function createModel(gl, read) {
  const { name, count, degree, means, logScales: s, sigmaD, growthD, settings, screenFilter, calibration, against } = read;
  const { records, sh } = upload(gl, read), extent = extentOf(read), worker = startWorker();
  const scales = Float32Array.from({ length: count }, (_, i) => Math.exp(Math.max(s[3 * i], s[3 * i + 1], s[3 * i + 2])));
  const blur = screenFilter.variance, attenuation = settings, maxDial = settings?.max_sv ?? 1;
  const whole = settings ? wholeCount(count, sigmaD, settings) : count;
  worker.request("model", { means, scales, sigmaD, growthD, attenuation, blur }, [means.buffer, scales.buffer]);
  return {
    name, attenuation, maxDial, screenFilter, calibration, against, count, degree, records, sh, extent, whole,
    /** {rows, drawn, kept}: the rows to draw, farthest first. */
    order: (shown) => worker.request("order", shown),
    dialFor: (view, target) => worker.request("dialFor", { view, target, maxDial }),
    destroy() {
      worker.terminate();
      gl.deleteTexture(records);
      gl.deleteTexture(sh);
    },
  };
}

/** A separate function, so that no closure of the model keeps the values in memory after the upload. */
function upload(gl, gaussians) {
  const texels = SH_TEXELS[gaussians.degree], most = Math.floor((WIDTH * gl.getParameter(gl.MAX_TEXTURE_SIZE)) / Math.max(texels, 4));
  const failed = (what) => new Error(`this graphics device ${what} Gaussians; export it at a larger dial value (--sv)`);
  if (gaussians.count > most) throw failed(`holds at most ${most} of the ${gaussians.count}`);
  if (gl.isContextLost()) throw new Error("the graphics device was lost; reload the page");
  const records = dataTexture(gl, 4 * gaussians.count, Float32Array, (target) => fillRecords(target, gaussians));
  const sh = dataTexture(gl, texels * gaussians.count, Uint32Array, (target) => fillSh(target, gaussians, texels));
  if (gl.getError() !== gl.OUT_OF_MEMORY) return { records, sh };
  for (const each of [records, sh]) gl.deleteTexture(each);
  throw failed(`has too little memory for ${gaussians.count}`);
}

function fillRecords(target, { count, means, quats, logScales, opacityLogits, sh0, sigmaD, growthD }) {
  for (let i = 0; i < count; i++) {
    const [a, b, c, d] = quats.subarray(4 * i, 4 * i + 4), norm = Math.hypot(a, b, c, d), at = 3 * i;
    const opacity = 1 / (1 + Math.exp(-opacityLogits[i])), color = (k) => 0.5 + SH_C0 * sh0[at + k], scale = (k) => Math.exp(logScales[at + k]);
    target.set([means[at], means[at + 1], means[at + 2], opacity, a / norm, b / norm, c / norm, d / norm], 16 * i);
    target.set([scale(0), scale(1), scale(2), sigmaD?.[i] ?? 0, color(0), color(1), color(2), growthD?.[i] ?? 0], 16 * i + 8);
  }
}

/** SH of degrees 1 and up as float16: red, green and blue of each coefficient. */
function fillSh(target, { count, degree, shN }, texels) {
  const values = 3 * ((degree + 1) ** 2 - 1), halves = new Uint16Array(target.buffer);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < values; k++) halves[8 * texels * i + k] = half(shN[values * i + k]);
  }
}

const float = new Float32Array(1), bits = new Uint32Array(float.buffer);

/** Bits of the nearest float16; values beyond its range become the largest finite one. */
function half(value) {
  float[0] = value;
  const x = bits[0], sign = (x >>> 16) & 0x8000, magnitude = x & 0x7fffffff;
  if (magnitude >= 0x477ff000) return sign | 0x7bff;
  if (magnitude < 0x38800000) return sign | Math.round(Math.abs(value) * 2 ** 24); // subnormal
  return sign | ((magnitude - 0x38000000 + 0x0fff + ((magnitude >>> 13) & 1)) >>> 13);
}

/** A ball about the median with 98 % of a sample or, where that has twice the radius of 80 % by a background, with these. */
function extentOf(gaussians) {
  const { means, logScales, up } = gaussians, step = 3 * Math.max(Math.floor(means.length / 60000), 1), all = [];
  for (let at = 0; at < means.length; at += step) {
    const size = VISIBLE * Math.exp(Math.max(...logScales.subarray(at, at + 3)));
    all.push({ row: at / 3, point: means.subarray(at, at + 3), size });
  }
  const centre = [0, 1, 2].map((k) => Float32Array.from(all, ({ point }) => point[k]).sort()[all.length >> 1]);
  for (const each of all) each.reach = Math.hypot(...add(each.point, centre, -1)) + each.size;
  const reaches = Float64Array.from(all, ({ reach }) => reach).sort(), share = (part) => reaches[Math.floor(part * all.length)];
  const radius = share(0.98) < 2 * share(0.8) ? share(0.98) : share(0.8);
  const near = all.filter(({ reach }) => reach <= radius).map(({ row }) => row);
  return { centre, radius: Math.min(Math.max(radius, 1e-6), 1e30), up: up ?? upOf(gaussians, near), isStated: Boolean(up) };
}

/** The direction that flat Gaussians face, a ground or a table: from the first of UPS that has some, to the mean within 36 degrees. */
function upOf({ quats, logScales, opacityLogits }, rows) {
  const flat = rows.map((i) => {
    const [least, next] = logScales.subarray(3 * i, 3 * i + 3).toSorted(), thin = logScales.subarray(3 * i, 3 * i + 3).indexOf(least);
    const axis = [0, 1, 2].map((k) => Number(k === thin)), [w, ...v] = quats.subarray(4 * i, 4 * i + 4), twice = scaled(cross(v, axis), 2);
    const normal = unit(add(add(scaled(axis, w * w + dot(v, v)), twice, w), cross(v, twice))); // the axis rotated
    return { normal, weight: least + FLAT < next ? 1 / (1 + Math.exp(-opacityLogits[i])) : 0 };
  });
  const weigh = (normals) => normals.reduce((total, { weight }) => total + weight, 0);
  for (let up of UPS) {
    let near = flat;
    for (let step = 0; step < 10 && weigh(near); step++) {
      near = flat.filter(({ normal }) => Math.abs(dot(normal, up)) > BESIDE);
      up = unit(near.reduce((sum, { normal, weight }) => add(sum, normal, weight * Math.sign(dot(normal, up))), [0, 0, 0]));
    }
    if (weigh(near) > SURE * weigh(flat)) return up;
  }
  return UPS[0];
}

/** A worker of WORKER, the text of worker.js, with `request(job, message, transferred)`, whose answers have the order of the requests. */
function startWorker() {
  const url = URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" }));
  const worker = new Worker(url), waiting = [];
  worker.onmessage = ({ data: { error, result } }) => {
    const { resolve, reject } = waiting.shift();
    URL.revokeObjectURL(url);
    if (error) reject(new Error(error));
    else resolve(result);
  };
  worker.request = (job, message, transferred = []) => {
    worker.postMessage([job, message], transferred);
    return new Promise((resolve, reject) => { waiting.push({ resolve, reject }); });
  };
  return worker;
}

// A splat on the GPU, and the worker that culls and sorts its Gaussians.
import { WIDTH, dataTexture, heightOf, maxTexels } from "./gpu.js";
import { half } from "./half.js";
import { SH_TEXELS } from "./shaders.js";
import { upOfGaussians } from "./up.js";
import { add } from "./vector.js";
import workerSource from "worker:./worker.js";

const SH_C0 = 0.28209479177387814;
const RECORD_TEXELS = 4;
const VISIBLE = 3.4; // standard deviations to alpha 1/255

/** `metadata`: name, attenuation or null, screen_filter, no_dial, max_sv, calibration. */
export function createModel(gl, gaussians, metadata) {
  const { count, degree, means, opacityLogits } = gaussians, { records, sh } = upload(gl, gaussians);
  const attenuation = gaussians.sigmaD ? metadata.attenuation : null, extent = extentOf(gaussians), worker = startWorker();
  const { logScales: s, sigmaD = null, growthD = null } = gaussians, blur = metadata.screen_filter.variance;
  const scales = Float32Array.from({ length: count }, (_, i) => Math.exp(Math.max(s[3 * i], s[3 * i + 1], s[3 * i + 2])));
  worker.request("model", { means, opacityLogits, scales, sigmaD, growthD, attenuation, blur }, [means.buffer, scales.buffer]);
  const spare = []; // buffers for orders, which are transferred to the worker and back

  return {
    ...metadata, attenuation, count, degree, records, sh, extent,
    /** Requests the rows to draw, and calls `use({rows, drawn, kept, distance})`; `rows` is valid until it returns. */
    async order(state, use) {
      const buffer = spare.pop() ?? new ArrayBuffer(4 * WIDTH * heightOf(count));
      const result = await worker.request("order", { ...state, rows: buffer }, [buffer]);
      use({ ...result, rows: new Uint32Array(result.rows) });
      spare.push(result.rows);
    },
    dialFor: (view, target) => worker.request("dialFor", { view, target, maxSv: metadata.max_sv }),
    destroy() {
      worker.stop();
      gl.deleteTexture(records);
      gl.deleteTexture(sh);
    },
  };
}

/** A separate function, so that no closure of the model keeps the values in memory after the upload. */
function upload(gl, gaussians) {
  const texels = SH_TEXELS[gaussians.degree], most = Math.floor(maxTexels(gl) / Math.max(texels, RECORD_TEXELS));
  const holds = (what) => new Error(`this graphics device ${what} Gaussians; export it at a larger dial value (--sv)`), number = gaussians.count.toLocaleString("en");
  if (gaussians.count > most) throw holds(`holds at most ${most.toLocaleString("en")} of the ${number}`);
  if (gl.isContextLost()) throw new Error("the graphics device was lost; reload the page");
  const textures = {
    records: dataTexture(gl, RECORD_TEXELS * gaussians.count, Float32Array, (target) => fillRecords(target, gaussians)),
    sh: dataTexture(gl, texels * gaussians.count, Uint32Array, (target) => fillSh(target, gaussians, texels)),
  };
  if (gl.getError() !== gl.OUT_OF_MEMORY) return textures;
  for (const each of Object.values(textures)) gl.deleteTexture(each);
  throw holds(`has too little memory for ${number}`);
}

function fillRecords(target, { count, means, quats, logScales, opacityLogits, sh0, sigmaD, growthD }) {
  for (let i = 0, at = 0; i < count; i++, at += 16) {
    for (let k = 0; k < 3; k++) {
      target[at + k] = means[3 * i + k];
      target[at + 8 + k] = Math.exp(logScales[3 * i + k]);
      target[at + 12 + k] = 0.5 + SH_C0 * sh0[3 * i + k];
    }
    target[at + 3] = 1 / (1 + Math.exp(-opacityLogits[i]));
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    for (let k = 0; k < 4; k++) target[at + 4 + k] = quats[4 * i + k] / norm;
    target[at + 11] = sigmaD ? sigmaD[i] : 0;
    target[at + 15] = growthD ? growthD[i] : 0;
  }
}

/** SH of degrees 1 and up as float16: red, green and blue of each coefficient. */
function fillSh(target, { count, degree, shN }, texels) {
  const values = 3 * ((degree + 1) ** 2 - 1), halves = new Uint16Array(target.buffer);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < values; k++) halves[8 * texels * i + k] = half(shN[values * i + k]);
  }
}

/** {centre, radius, up}: a ball that contains a sample of the Gaussians, and their up axis. Where more than 2 % of them are beyond twice the radius
 *  that contains 80 %, a background, it is the ball of these about the median. */
function extentOf(gaussians) {
  const { means, logScales } = gaussians;
  const step = Math.max(Math.floor(means.length / 3 / 20000), 1), points = [], sizes = [];
  for (let at = 0; at < means.length; at += 3 * step) {
    points.push([means[at], means[at + 1], means[at + 2]]);
    sizes.push(VISIBLE * Math.exp(Math.max(logScales[at], logScales[at + 1], logScales[at + 2])));
  }
  const reachesFrom = (centre) => Float64Array.from(points, (point, i) => Math.hypot(...add(point, centre, -1)) + sizes[i]);
  const axes = [0, 1, 2].map((k) => Float64Array.from(points, (point) => point[k]).sort());
  const median = axes.map((values) => values[values.length >> 1]), reaches = reachesFrom(median), sorted = reaches.slice().sort();
  const bulk = sorted[Math.floor(0.8 * sorted.length)], bounded = sorted[Math.floor(0.98 * sorted.length)] < 2 * bulk;
  const rows = [...points.keys()].filter((i) => reaches[i] <= (bounded ? 2 : 1) * bulk), near = rows.map((i) => points[i]);
  const up = upOfGaussians(gaussians, rows.map((i) => i * step));
  if (!bounded) return { centre: median, radius: Math.min(Math.max(bulk, 1e-6), 1e30), up };
  const bounds = [0, 1, 2].map((k) => near.reduce(([low, high], point) => [Math.min(low, point[k]), Math.max(high, point[k])], [Infinity, -Infinity]));
  const centre = bounds.map(([low, high]) => (low + high) / 2), radius = reachesFrom(centre).filter((_, i) => reaches[i] <= 2 * bulk).sort().at(-1);
  return { centre, radius: Math.min(Math.max(radius, 1e-6), 1e30), up };
}

function startWorker() {
  const url = URL.createObjectURL(new Blob([workerSource], { type: "text/javascript" }));
  const worker = new Worker(url), waiting = new Map();
  let next = 0;
  worker.onmessage = ({ data }) => {
    const { resolve, reject } = waiting.get(data.id);
    waiting.delete(data.id);
    URL.revokeObjectURL(url);
    if (data.error) reject(new Error(data.error));
    else resolve(data);
  };
  return {
    request: (job, message, transferred = []) =>
      new Promise((resolve, reject) => {
        waiting.set(++next, { resolve, reject });
        worker.postMessage({ id: next, job, ...message }, transferred);
      }),
    stop: () => worker.terminate(),
  };
}

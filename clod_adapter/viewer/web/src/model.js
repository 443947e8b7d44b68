// One splat on the GPU, and its worker, which knows who is kept at a dial value and in which order they are drawn.
import { WIDTH, dataTexture, heightOf, mostTexels } from "./gpu.js";
import { half } from "./half.js";
import { BAND_TEXELS } from "./shaders.js";
import workerSource from "worker:./worker.js";

const SH_C0 = 0.28209479177387814;
const RECORD_TEXELS = 4;

/** `about`: name, attenuation or null, screen_filter, no_dial, max_sv, calibration. `gaussians`: as the readers in formats/ make them. */
export function createModel(gl, gaussians, about) {
  const { count, degree, means, opacityLogits } = gaussians, { records, higher } = upload(gl, gaussians);
  const attenuation = gaussians.sigma ? about.attenuation : null, extent = extentOf(gaussians), worker = startWorker();
  worker.ask("model", { means, opacityLogits, sigma: attenuation && gaussians.sigma, attenuation }, [means.buffer]);
  const spare = []; // buffers for orders, which go to the worker and back
  return {
    ...about, attenuation, count, degree, records, higher, extent,
    /** Has the worker find the rows to draw, and calls `use({rows, drawn, kept, distance})` with them. */
    async order(request, use) {
      const buffer = spare.pop() ?? new ArrayBuffer(4 * WIDTH * heightOf(count));
      const answer = await worker.ask("order", { ...request, rows: buffer }, [buffer]);
      use({ ...answer, rows: new Uint32Array(answer.rows) });
      spare.push(answer.rows);
    },
    dialFor: (view, wanted) => worker.ask("dialFor", { view, wanted, maxSv: about.max_sv }),
    destroy() {
      worker.stop();
      gl.deleteTexture(records);
      gl.deleteTexture(higher);
    },
  };
}

/** Apart, so that nothing that lives on holds the values after they are on the GPU. */
function upload(gl, gaussians) {
  const texels = BAND_TEXELS[gaussians.degree], integer = new Intl.NumberFormat("en").format;
  if (gl.isContextLost()) throw new Error("the graphics device went away; reload the page");
  const most = Math.floor(mostTexels(gl) / Math.max(texels, RECORD_TEXELS));
  if (gaussians.count > most) {
    throw new Error(`it has ${integer(gaussians.count)} Gaussians; this graphics device takes ${integer(most)} of its SH degree`);
  }
  const made = {
    records: dataTexture(gl, RECORD_TEXELS * gaussians.count, Float32Array, (target) => fillRecords(target, gaussians)),
    higher: dataTexture(gl, texels * gaussians.count, Uint32Array, (target) => fillBands(target, gaussians, texels)),
  };
  if (gl.getError() !== gl.OUT_OF_MEMORY) return made;
  for (const each of Object.values(made)) gl.deleteTexture(each);
  throw new Error(`this graphics device has too little memory for its ${integer(gaussians.count)} Gaussians`);
}

function fillRecords(target, { count, means, quats, logScales, opacityLogits, sh0, sigma }) {
  for (let i = 0, at = 0; i < count; i++, at += 16) {
    for (let k = 0; k < 3; k++) {
      target[at + k] = means[3 * i + k];
      target[at + 8 + k] = Math.exp(logScales[3 * i + k]);
      target[at + 12 + k] = 0.5 + SH_C0 * sh0[3 * i + k];
    }
    target[at + 3] = 1 / (1 + Math.exp(-opacityLogits[i]));
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    for (let k = 0; k < 4; k++) target[at + 4 + k] = quats[4 * i + k] / norm;
    target[at + 11] = sigma ? sigma[i] : 0;
  }
}

/** Coefficient by coefficient, red, green and blue of each, as halves. */
function fillBands(target, { count, degree, shN }, texels) {
  const values = 3 * ((degree + 1) ** 2 - 1), halves = new Uint16Array(target.buffer);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < values; k++) halves[8 * texels * i + k] = half(shN[values * i + k]);
  }
}

/** Where the bulk of the Gaussians is: the median, and the distance that holds 80 % of a sample of them; of few large
 *  ones three times their size. */
function extentOf({ means, logScales }) {
  const step = Math.max(Math.floor(means.length / 3 / 20000), 1), axes = [[], [], []];
  for (let i = 0; i < means.length / 3; i += step) for (let k = 0; k < 3; k++) axes[k].push(means[3 * i + k]);
  const centre = axes.map((axis) => Float64Array.from(axis).sort()[axis.length >> 1]);
  const distances = Float64Array.from(axes[0], (x, i) => Math.hypot(x - centre[0], axes[1][i] - centre[1], axes[2][i] - centre[2]));
  const sizes = Float64Array.from(axes[0], (_, i) => Math.exp(Math.max(...logScales.subarray(3 * step * i, 3 * step * i + 3))));
  const radius = Math.max(distances.sort()[Math.floor(0.8 * distances.length)], 3 * sizes.sort()[sizes.length >> 1]);
  return { centre, radius: Math.min(Math.max(radius, 1e-6), 1e30) };
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
    ask: (job, message, moved = []) =>
      new Promise((resolve, reject) => {
        waiting.set(++next, { resolve, reject });
        worker.postMessage({ id: next, job, ...message }, moved);
      }),
    stop: () => worker.terminate(),
  };
}

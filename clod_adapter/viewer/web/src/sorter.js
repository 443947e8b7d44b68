// Culls and sorts the Gaussians of a model by WebGPU: what the worker does (worker.js), in float32. The rows are read back,
// since WebGL draws them.
import attenuationSource from "../../../integrations/shaders/attenuation.wgsl";
import { growthDistance } from "../../../../viewers/equation.js";
import { frustumOf } from "./frustum.js";
import { WIDTH, heightOf } from "./gpu.js";
import source from "./sorter.wgsl";

const LANES = 256, BLOCK = 16 * LANES, PASSES = 4; // of sorter.wgsl
const KEPT = 4 * PASSES + 4, TALLY_BYTES = 96; // words before the count of kept Gaussians; bytes of `tally`
const BINDINGS = { cull: [0, 1, 2, 3], histogram: [3, 4, 5, 9], scan: [3, 4, 9], scatter: [3, 4, 5, 6, 7, 8, 9] }; // of the kernels
const MAX_GROUPS = 65535; // of one dispatch, on every device

const SOFTWARE = /SwiftShader|llvmpipe|softpipe|Basic Render/; // names of WebGL's renderers

/** {gpu, pipelines}: a device and its kernels; null where the browser has no WebGPU, or only in software, where the worker
 *  is faster. Where WebGL is drawn in software it is not asked, since Chromium then logs that it has no adapter. */
export async function sortingDevice(gl) {
  try {
    const { UNMASKED_RENDERER_WEBGL: unmasked } = gl.getExtension("WEBGL_debug_renderer_info") ?? {};
    if (SOFTWARE.test(gl.getParameter(unmasked ?? gl.RENDERER))) return null;
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter || adapter.info.isFallbackAdapter) return null;
    const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits;
    const gpu = await adapter.requestDevice({ requiredLimits: { maxBufferSize, maxStorageBufferBindingSize } });
    const module = gpu.createShaderModule({ code: attenuationSource + source });
    const compile = (entryPoint) => gpu.createComputePipelineAsync({ layout: "auto", compute: { module, entryPoint } });
    return { gpu, pipelines: await Promise.all(Object.keys(BINDINGS).map(compile)) };
  } catch {
    return null;
  }
}

/** `device`: promise of that; `scales`: from largestScales. Null where it cannot sort this model: the device has too little
 *  memory, or the unit of the distances depends on the view. */
export async function createSorter(device, gaussians, scales, { attenuation, screen_filter: filter }) {
  if (!navigator.gpu || (attenuation && attenuation.normalizer !== "scene")) return null;
  const { count } = gaussians, packed = pack(gaussians, scales); // now, because the caller transfers the arrays
  const { gpu, pipelines } = (await device) ?? {};
  if (!gpu || packed.byteLength > gpu.limits.maxStorageBufferBindingSize || count > MAX_GROUPS * LANES) return null;
  const buffers = await allocate(gpu, count);
  if (!buffers) return null;
  gpu.queue.writeBuffer(buffers.gaussians, 0, packed);
  const [cull, histogram, scan, scatter] = bind(gpu, pipelines, buffers), spare = [], groups = Math.ceil(count / BLOCK);

  function encode(copy) {
    const encoder = gpu.createCommandEncoder(), pass = encoder.beginComputePass();
    const set = ({ pipeline, bound }, index) => {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, bound[index]);
    };
    set(cull, 0);
    pass.dispatchWorkgroups(Math.ceil(count / LANES));
    for (let index = 0; index < PASSES; index++) {
      set(histogram, index);
      pass.dispatchWorkgroupsIndirect(buffers.tally, 16 * index);
      set(scan, index);
      pass.dispatchWorkgroups(1);
      set(scatter, index);
      pass.dispatchWorkgroupsIndirect(buffers.tally, 16 * index);
    }
    pass.end();
    encoder.copyBufferToBuffer(buffers.tally, 0, copy, 0, TALLY_BYTES);
    encoder.copyBufferToBuffer(buffers.rows0, 0, copy, TALLY_BYTES, 4 * count);
    return encoder.finish();
  }

  return {
    /** As the worker's job of this name. `done()` takes `rows` back. */
    async order({ view, dial, equation, marks, frustum }) {
      const on = equation && attenuation !== null, distance = on ? attenuation.scene_distance : 1;
      const size = TALLY_BYTES + 4 * WIDTH * heightOf(count);
      const copy = spare.pop() ?? gpu.createBuffer({ size, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
      const frame = frameOf(view, on ? { dial, distance, ...attenuation } : null, filter.variance, [marks, frustum], count);
      gpu.queue.writeBuffer(buffers.frame, 0, frame);
      gpu.queue.writeBuffer(buffers.tally, 0, new Uint32Array([groups, 1, 1, count, ...Array(PASSES).fill([0, 1, 1, 0]).flat(), 0]));
      gpu.queue.submit([encode(copy)]);
      await copy.mapAsync(GPUMapMode.READ);
      const tally = new Uint32Array(copy.getMappedRange(0, TALLY_BYTES));
      const done = () => { copy.unmap(); spare.push(copy); };
      return { rows: new Uint32Array(copy.getMappedRange(TALLY_BYTES)), kept: tally[KEPT], drawn: tally[KEPT - 1], distance, done };
    },
    destroy() {
      for (const each of [...Object.values(buffers).flat(), ...spare]) each.destroy();
    },
  };
}

/** The largest scale of each Gaussian. */
export const largestScales = ({ count, logScales: s }) =>
  Float32Array.from({ length: count }, (_, i) => Math.exp(Math.max(s[3 * i], s[3 * i + 1], s[3 * i + 2])));

function pack({ count, means, opacityLogits, sigmaD, growthD }, scales) {
  const packed = new Float32Array(8 * count);
  for (let i = 0, at = 0; i < count; i++, at += 8) {
    for (let k = 0; k < 3; k++) packed[at + k] = means[3 * i + k];
    packed[at + 3] = 1 / (1 + Math.exp(-opacityLogits[i]));
    packed[at + 4] = scales[i];
    packed[at + 5] = sigmaD ? sigmaD[i] : 0;
    packed[at + 6] = growthD ? growthD[i] : 0;
  }
  return packed;
}

/** The struct Frame. */
function frameOf(view, attenuated, blur, flags, count) {
  const { rotation: r, eye, near } = view, { focal, shift, border, reach: extent } = frustumOf(view, blur);
  const { dial, eps, tau, distance } = attenuated ?? { dial: 1, eps: 1, tau: 0, distance: 1 };
  const reach = attenuated ? growthDistance(attenuated) : 1;
  const values = [...r.slice(0, 3), dial, ...r.slice(3, 6), eps, ...r.slice(6), near, ...eye, distance];
  const frame = new Float32Array([...values, ...focal, ...shift, ...border, ...extent, tau, reach, ...Array(6).fill(0)]);
  new Uint32Array(frame.buffer).set([count, attenuated !== null, ...flags], 26);
  return frame;
}

/** The buffers; null if the device has too little memory. */
async function allocate(gpu, count) {
  const { STORAGE, UNIFORM, COPY_DST, COPY_SRC, INDIRECT } = GPUBufferUsage;
  const create = (size, usage) => gpu.createBuffer({ size, usage: usage | COPY_DST });
  gpu.pushErrorScope("out-of-memory");
  const buffers = {
    frame: create(128, UNIFORM), gaussians: create(32 * count, STORAGE), tally: create(TALLY_BYTES, STORAGE | INDIRECT | COPY_SRC),
    places: create(4 * LANES * Math.ceil(count / BLOCK), STORAGE), passes: Array.from({ length: PASSES }, () => create(16, UNIFORM)),
    keys0: create(4 * count, STORAGE), keys1: create(4 * count, STORAGE),
    rows0: create(4 * count, STORAGE | COPY_SRC), rows1: create(4 * count, STORAGE),
  };
  buffers.passes.forEach((each, index) => gpu.queue.writeBuffer(each, 0, new Uint32Array([index])));
  if (!(await gpu.popErrorScope())) return buffers;
  for (const each of Object.values(buffers).flat()) each.destroy();
  return null;
}

/** {pipeline, bound} of each kernel: with its buffers in each pass. */
function bind(gpu, pipelines, { frame, gaussians, tally, places, passes, keys0, keys1, rows0, rows1 }) {
  return Object.values(BINDINGS).map((bindings, kernel) => {
    const pipeline = pipelines[kernel], layout = pipeline.getBindGroupLayout(0);
    const bound = passes.map((index, k) => {
      const moved = k % 2 ? [keys1, rows1, keys0, rows0] : [keys0, rows0, keys1, rows1];
      const all = [frame, gaussians, keys0, tally, index, ...moved, places];
      return gpu.createBindGroup({ layout, entries: bindings.map((binding) => ({ binding, resource: { buffer: all[binding] } })) });
    });
    return { pipeline, bound };
  });
}

// The worker of a model: culls the Gaussians for each camera and dial value, and sorts the others in the picture by depth.
import {
  bandsOf, beginOf, countKept, dialForCount, endOf, growthFactor, growthStart, isKept,
} from "../../../../viewers/equation.js";

const WIDTH = 2048; // texels per row of a texture (gpu.js)
const MARGIN = 0.25; // of the picture on each side: Gaussians that a moving camera shows before the next order
const RADIUS = 3.34; // standard deviations to alpha 1/255, and more than in shaders.js

let means, scales, sigmaD, growthD, blur, attenuation, keys, scratchKeys, scratchRows;

const jobs = {
  model(message) {
    ({ means, scales, sigmaD, growthD, blur, attenuation } = message);
    [keys, scratchKeys, scratchRows] = [0, 1, 2].map(() => new Uint32Array(scales.length));
  },

  order: ({ view, dial, attenuated }) => cullAndSort(view, attenuated ? dial : null), // null: without the equation

  dialFor({ view, target, maxDial }) {
    const bands = bandsOf(means, sigmaD, view.eye, attenuation), dial = dialForCount(bands, target, maxDial);
    return { dial, kept: countKept(bands, dial) };
  },
};

/** The rows with a pixel in the picture or its margin, farthest first; numbers of `kept` and `drawn` Gaussians. */
function cullAndSort({ rotation: r, eye, near, fx, fy, cx, cy, width, height }, dial) {
  const rows = new Uint32Array(WIDTH * Math.ceil(scales.length / WIDTH)), [ex, ey, ez] = eye;
  const bits = new Uint32Array(1), depth = new Float32Array(bits.buffer);
  // Of depth, how far the picture with its margin extends; and how far a scale of 1 does, as in shaders.js.
  const border = (focal, centre, size) => (Math.max(centre, size - centre) + MARGIN * size + RADIUS * Math.sqrt(blur)) / focal;
  const reach = (focal, centre, size) => RADIUS * Math.hypot(1, (Math.max(centre, size - centre) + 0.15 * size) / focal);
  const bx = border(fx, cx, width), by = border(fy, cy, height), sx = reach(fx, cx, width), sy = reach(fy, cy, height);
  const hides = attenuation?.near_distance > 0; // without the equation, far Gaussians
  let kept = 0, drawn = 0;
  for (let i = 0, at = 0; at < means.length; i++, at += 3) {
    const x = means[at] - ex, y = means[at + 1] - ey, z = means[at + 2] - ez;
    if (!(dial === null ? !hides || sigmaD[i] <= 0 : keeps(sigmaD[i], x * x + y * y + z * z, dial))) continue;
    kept++;
    depth[0] = r[6] * x + r[7] * y + r[8] * z;
    if (!(depth[0] >= near)) continue;
    const across = Math.abs(r[0] * x + r[1] * y + r[2] * z) - bx * depth[0];
    const down = Math.abs(r[3] * x + r[4] * y + r[5] * z) - by * depth[0];
    const needed = Math.max(across / sx, down / sy); // the scale that reaches the margin
    if (needed > scales[i] && !(needed <= scales[i] * growthOf(i, Math.hypot(x, y, z), dial))) continue;
    keys[drawn] = ~bits[0]; // positive floats have the order of their bits
    rows[drawn++] = i;
  }
  radixPass(rows, drawn, 0, keys, scratchKeys, scratchRows);
  radixPass(scratchRows, drawn, 16, scratchKeys, keys, rows);
  return { rows, kept, drawn };
}

const keeps = (sigma, squared, dial) => isKept(beginOf(sigma, squared, attenuation), endOf(sigma, squared, attenuation), dial);

function growthOf(i, far, dial) {
  if (dial === null || !(growthD?.[i] > 0)) return 1; // or less, where it shrinks
  return growthFactor(growthD[i], (dial * far) / attenuation.scene_distance / growthStart(attenuation));
}

/** One pass of a radix sort by 16 bits of the keys. It is exact and stable: equal depths keep the file's order. */
function radixPass(rows, count, shift, from, to, toRows) {
  const starts = new Uint32Array(65537);
  for (let i = 0; i < count; i++) starts[((from[i] >>> shift) & 65535) + 1]++;
  for (let b = 0; b < 65536; b++) starts[b + 1] += starts[b];
  for (let i = 0; i < count; i++) {
    const at = starts[(from[i] >>> shift) & 65535]++;
    to[at] = from[i];
    toRows[at] = rows[i];
  }
}

self.onmessage = ({ data: [job, message] }) => {
  try {
    const result = jobs[job](message);
    self.postMessage({ result }, result?.rows ? [result.rows.buffer] : []);
  } catch (error) {
    self.postMessage({ error: String(error?.message ?? error) });
  }
};

// The worker of a model: culls the Gaussians for each camera and dial value, and sorts the kept ones by depth. Those that are
// culled or outside the picture are neither sorted nor drawn.
import { dialForCount, extinctionScales, growthDistance, growthFactor, normalizingDistance, prepare } from "../../../../viewers/equation.js";
import { frustumOf } from "./frustum.js";

let means, scales, growthD, blur, attenuation, prepared, keys, scratchKeys, scratchRows;

const jobs = {
  model(message) {
    ({ means, scales, growthD, blur, attenuation } = message);
    const count = means.length / 3;
    prepared = attenuation && prepare(message.opacityLogits, message.sigmaD, attenuation.eps);
    [keys, scratchKeys, scratchRows] = [0, 1, 2].map(() => new Uint32Array(count));
    return [{}, []];
  },

  /** Writes the rows to draw, farthest first, into the buffer `rows`, which is transferred in both directions. */
  order({ view, dial, equation, rows }) {
    const on = equation && attenuation !== null;
    const distance = on ? normalizingDistance(means, view, attenuation) : 1;
    const order = new Uint32Array(rows);
    const [kept, drawn] = cullAndSort(order, view, on ? { dial, distance } : null, insideOf(view, on && dial / distance));
    return [{ rows, kept, drawn, distance }, [rows]];
  },

  dialFor({ view, target, maxSv }) {
    const distance = normalizingDistance(means, view, attenuation);
    const found = extinctionScales(means, prepared, view.eye, distance, attenuation.tau);
    return [dialForCount(found, target, maxSv), []];
  },
};

/** Whether row i, at [x, y, z] from the eye and a depth, has a pixel in the picture or its margin. `far`: s d per distance, of
 *  growth; false without the equation. */
function insideOf(view, far) {
  const { rotation: r } = view, { focal, shift, border, reach } = frustumOf(view, blur), reference = far && growthDistance(attenuation);
  const [fx, fy] = focal, [sx, sy] = shift, [bx, by] = border, [ex, ey] = reach;
  return (i, x, y, z, depth) => {
    const across = Math.abs(fx * (r[0] * x + r[1] * y + r[2] * z) + sx * depth) - bx * depth;
    const down = Math.abs(fy * (r[3] * x + r[4] * y + r[5] * z) + sy * depth) - by * depth;
    const needed = Math.max(across / ex, down / ey); // the scale that reaches the margin
    if (needed <= scales[i]) return true; // or less, where it shrinks
    return far && growthD && growthD[i] > 0 && needed <= scales[i] * growthFactor(growthD[i], far * Math.hypot(x, y, z) / reference);
  };
}

/** Fills `order` with the kept rows in front of the camera and `inside`, farthest first; returns the counts of kept and of
 *  drawn Gaussians. `attenuated`: {dial, distance}; null keeps all. */
function cullAndSort(order, { rotation: r, eye, near }, attenuated, inside) {
  const [ex, ey, ez] = eye;
  const k = attenuated ? (attenuated.dial / attenuated.distance) ** 2 : 0;
  const threshold = attenuated ? Math.log(attenuation.tau * attenuated.dial) : 0;
  const bits = new Uint32Array(1), depth = new Float32Array(bits.buffer);
  let kept = 0, drawn = 0;
  for (let i = 0, at = 0; at < means.length; i++, at += 3) {
    const x = means[at] - ex, y = means[at + 1] - ey, z = means[at + 2] - ez;
    if (attenuated && !(prepared.logA[i] - k * (x * x + y * y + z * z) * prepared.inverse[i] > threshold)) continue;
    kept++;
    depth[0] = r[6] * x + r[7] * y + r[8] * z;
    if (!(depth[0] >= near && inside(i, x, y, z, depth[0]))) continue;
    keys[drawn] = ~bits[0]; // positive floats have the order of their bits
    order[drawn++] = i;
  }
  radixPass(order, drawn, 0, keys, scratchKeys, scratchRows);
  radixPass(scratchRows, drawn, 16, scratchKeys, keys, order);
  return [kept, drawn];
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

self.onmessage = ({ data: { id, job, ...rest } }) => {
  try {
    const [result, transferred] = jobs[job](rest);
    self.postMessage({ id, ...result }, transferred);
  } catch (error) {
    self.postMessage({ id, error: String(error?.message ?? error) });
  }
};

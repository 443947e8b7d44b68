// The worker: for each camera and dial value it finds who is kept, and sorts them by depth, so that the page
// draws no others. One worker per model.
import { dialForCount, extinctionScales, normalizingDistance, prepare } from "./equation.js";

let means, attenuation, prepared, keys, spareKeys, spareRows;

const jobs = {
  model(message) {
    ({ means, attenuation } = message);
    const count = means.length / 3;
    prepared = attenuation && prepare(message.opacityLogits, message.sigma, attenuation.eps);
    [keys, spareKeys, spareRows] = [0, 1, 2].map(() => new Uint32Array(count));
    return [{}, []];
  },

  /** The rows to draw, the farthest first, in `rows`, a buffer that goes forth and back. */
  order({ view, dial, equation, rows }) {
    const on = equation && attenuation !== null;
    const distance = on ? normalizingDistance(means, view, attenuation) : 1;
    const order = new Uint32Array(rows);
    const [kept, drawn] = select(order, view, on ? { dial, distance } : null);
    return [{ rows, kept, drawn, distance }, [rows]];
  },

  dialFor({ view, wanted, maxSv }) {
    const distance = normalizingDistance(means, view, attenuation);
    const scales = extinctionScales(means, prepared, view.eye, distance, attenuation.tau);
    return [dialForCount(scales, wanted, maxSv), []];
  },
};

/** Fills `order` with the kept rows in front of the camera, the farthest first; returns [kept, of these in front]. */
function select(order, { rotation: r, eye, near }, dialled) {
  const [ex, ey, ez] = eye;
  const k = dialled ? (dialled.dial / dialled.distance) ** 2 : 0;
  const threshold = dialled ? Math.log(attenuation.tau * dialled.dial) : 0;
  const bits = new Uint32Array(1), depth = new Float32Array(bits.buffer);
  let kept = 0, drawn = 0;
  for (let i = 0, at = 0; at < means.length; i++, at += 3) {
    const x = means[at] - ex, y = means[at + 1] - ey, z = means[at + 2] - ez;
    if (dialled && !(prepared.logA[i] - k * (x * x + y * y + z * z) * prepared.inverse[i] > threshold)) continue;
    kept++;
    depth[0] = r[6] * x + r[7] * y + r[8] * z;
    if (!(depth[0] >= near)) continue;
    keys[drawn] = ~bits[0]; // positive floats order as their bits do
    order[drawn++] = i;
  }
  sort(order, drawn, 0, keys, spareKeys, spareRows);
  sort(spareRows, drawn, 16, spareKeys, keys, order);
  return [kept, drawn];
}

/** One pass of a radix sort by 16 bits of the keys: exact and stable, so equal depths keep the file's order. */
function sort(rows, count, shift, from, to, toRows) {
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
    const [answer, moved] = jobs[job](rest);
    self.postMessage({ id, ...answer }, moved);
  } catch (error) {
    self.postMessage({ id, error: String(error?.message ?? error) });
  }
};

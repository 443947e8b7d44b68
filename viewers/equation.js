// The dial's equation in float64, as in clod_adapter/equation/. A Gaussian is kept iff
// log a - (d s)^2 / (2 v) > log(tau s),  d = |mean - eye| / D,  2 v = 2 relu(sigma_d)^2 + eps,  a the opacity. Runs in the
// worker (worker.js). Culling by the dial does not use growth_d; by the picture's edges it does.

const HUGE = 1e300; // replaces 1/0: 0 * HUGE is 0, as at d = 0 a Gaussian is not attenuated for any sigma_d

/** log a and 1 / (2 v) of each Gaussian, which do not depend on the camera. */
export function prepare(opacityLogits, sigmaD, eps) {
  const count = opacityLogits.length;
  const logA = new Float64Array(count), inverse = new Float64Array(count);
  for (let i = 0; i < count; i++) {
    const l = opacityLogits[i], sigma = Math.max(sigmaD[i], 0);
    logA[i] = l >= 0 ? -Math.log1p(Math.exp(-l)) : l - Math.log1p(Math.exp(l));
    inverse[i] = Math.min(1 / (2 * sigma * sigma + eps), HUGE);
  }
  return { logA, inverse };
}

/** D, the unit of the distances, in world units (attenuation.normalizing_distance). */
export function normalizingDistance(means, view, attenuation) {
  if (attenuation.normalizer === "scene") return attenuation.scene_distance;
  const [x, y, z] = view.eye, count = means.length / 3;
  const buffer = new Float64Array(count);
  let size = 0;
  for (const ignoreFrustum of [false, true]) {
    for (let i = 0; i < count; i++) {
      const px = means[3 * i], py = means[3 * i + 1], pz = means[3 * i + 2];
      if (ignoreFrustum || inFrustum(px, py, pz, view)) buffer[size++] = Math.hypot(px - x, py - y, pz - z);
    }
    if (size) break;
  }
  if (!size) return 1;
  const distances = buffer.subarray(0, size);
  if (attenuation.normalizer === "max") return Math.max(distances.reduce((a, b) => Math.max(a, b)), 2 ** -126);
  const rank = Math.min(Math.max(Math.ceil(attenuation.quantile * size), 1), size);
  return Math.max(distances.sort()[rank - 1], 2 ** -126);
}

function inFrustum(px, py, pz, { rotation: r, eye, fx, fy, cx, cy, width, height, near }) {
  const x = px - eye[0], y = py - eye[1], z = pz - eye[2];
  const depth = r[6] * x + r[7] * y + r[8] * z;
  if (!(depth > near)) return false;
  const u = fx * (r[0] * x + r[1] * y + r[2] * z) + cx * depth;
  const v = fy * (r[3] * x + r[4] * y + r[5] * z) + cy * depth;
  return u >= 0 && u < width * depth && v >= 0 && v < height * depth;
}

/** r, in units of D: the distance from which on scales grow (equation/growth.py). */
export function growthDistance({ normalizer, reference_distance: reference, scene_distance: unit }) {
  return normalizer === "scene" && reference ? reference / unit : 1;
}

/** The factor of the scales of a kept Gaussian (equation/growth.py). `magnification`: s d / r. */
export const growthFactor = (growth, magnification) =>
  Math.exp(Math.min(Math.max(growth * Math.log(Math.min(Math.max(magnification, 1), 3e38)), -20), 20));

/** Extinction scales s*, descending. */
export const extinctionScales = (...of) => extinctions(...of).sort().reverse();

/** Extinction scale s* of each Gaussian, which is kept iff s < s*. In closed form by Lambert's W. */
export function extinctions(means, { logA, inverse }, eye, distance, tau) {
  const scales = new Float64Array(logA.length);
  for (let i = 0; i < logA.length; i++) {
    const d = Math.hypot(means[3 * i] - eye[0], means[3 * i + 1] - eye[1], means[3 * i + 2] - eye[2]) / distance;
    const ratio = d * Math.sqrt(2 * inverse[i]); // d / sqrt(v)
    const w = lambertOfExp(2 * (logA[i] - Math.log(tau) + Math.log(ratio)));
    scales[i] = w < 1 ? Math.exp(logA[i] - 0.5 * w) / tau : Math.sqrt(w) / ratio; // equal; each is used where it is exact
  }
  return scales;
}

/** W(e^x): the w > 0 with w + log w = x (Fritsch, Shafer and Crowley, CACM 16(2), 1973). */
function lambertOfExp(x) {
  x = Math.min(Math.max(x, -80), 1e4);
  let w = x > 1 ? x - Math.log(x) : 1 / (1 + Math.exp(-x));
  for (let step = 0; step < 2; step++) {
    const r = x - Math.log(w) - w, q = 2 * (1 + w) * (1 + w + (2 / 3) * r);
    w *= 1 + (r / (1 + w)) * ((q - r) / (q - 2 * r));
  }
  return w;
}

/** The number of Gaussians kept at a dial value, from descending s*. */
export function countAt(scales, dial) {
  let low = 0, high = scales.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (scales[middle] > dial) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The smallest dial value in [1, maxSv] that keeps at most `target` Gaussians (budget.dial_for), and the number kept. */
export function dialForCount(scales, target, maxSv) {
  const maxCount = countAt(scales, 1), minCount = countAt(scales, maxSv);
  if (target >= maxCount) return { dial: 1, kept: maxCount };
  if (target <= minCount) return { dial: maxSv, kept: minCount };
  const dial = Math.min(Math.sqrt(scales[target - 1] * scales[target]), maxSv);
  return { dial, kept: countAt(scales, dial) };
}

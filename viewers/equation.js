// The dial's equation in float64, as in clod_adapter/equation/. A Gaussian is kept iff
// log a - (d s)^2 / (2 v) > log(tau s),  d = |mean - eye| / D,  2 v = 2 relu(sigma_d)^2 + eps,  a the opacity.

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
export function normalizingDistance(means, view, { normalizer, scene_distance }) {
  if (normalizer === "scene") return scene_distance;
  const [ex, ey, ez] = view.eye;
  let all = 0, inside = 0;
  for (let at = 0; at < means.length; at += 3) {
    const x = means[at] - ex, y = means[at + 1] - ey, z = means[at + 2] - ez, distance = Math.hypot(x, y, z);
    all = Math.max(all, distance);
    if (inFrustum(x, y, z, view)) inside = Math.max(inside, distance);
  }
  return Math.max(inside || all, 2 ** -126);
}

function inFrustum(x, y, z, { rotation: r, fx, fy, cx, cy, width, height, near }) {
  const depth = r[6] * x + r[7] * y + r[8] * z;
  const u = fx * (r[0] * x + r[1] * y + r[2] * z) + cx * depth;
  const v = fy * (r[3] * x + r[4] * y + r[5] * z) + cy * depth;
  return depth > near && u >= 0 && u < width * depth && v >= 0 && v < height * depth;
}

/** r, in units of D: the distance from which on scales grow (equation/attenuation.py). */
export function growthDistance({ normalizer, reference_distance: reference, scene_distance: unit }) {
  return normalizer === "scene" && reference ? reference / unit : 1;
}

/** The factor of the scales of a kept Gaussian (equation/attenuation.py). `magnification`: s d / r. */
export const growthFactor = (growth, magnification) =>
  Math.exp(Math.min(Math.max(growth * Math.log(Math.min(Math.max(magnification, 1), 3e38)), -20), 20));

/** A function of i and its squared distance, in units of D: whether Gaussian i is kept at a dial value. */
export function keeping({ logA, inverse }, tau, dial) {
  const threshold = Math.log(tau * dial);
  return (i, squared) => logA[i] - dial * dial * squared * inverse[i] > threshold;
}

/** The number of Gaussians kept at a dial value, seen from an eye; `unit` is D. */
export function countKept(means, prepared, tau, eye, unit, dial) {
  const isKept = keeping(prepared, tau, dial);
  let kept = 0;
  for (let i = 0, at = 0; at < means.length; i++, at += 3) {
    const x = means[at] - eye[0], y = means[at + 1] - eye[1], z = means[at + 2] - eye[2];
    if (isKept(i, (x * x + y * y + z * z) / (unit * unit))) kept++;
  }
  return kept;
}

/** The smallest dial value in [1, largest] with `count(dial)` at most `target`, else the largest one, and that number. */
export function dialForCount(count, target, largest) {
  let [low, high] = count(1) <= target ? [1, 1] : [1, largest];
  for (let step = 0; step < 24 && low < high; step++) {
    const middle = Math.sqrt(low * high);
    if (count(middle) > target) low = middle;
    else high = middle;
  }
  return { dial: high, kept: count(high) };
}

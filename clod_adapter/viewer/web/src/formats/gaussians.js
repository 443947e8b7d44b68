// The result of every reader: float32 values as in Inria's PLY (logits of opacities, logarithms of scales, wxyz quaternions).

/** The dial's columns of a file, and the arrays with their values; a file without sigma_d has no dial. */
export const DIAL = { sigma_d: "sigmaD", growth_d: "growthD" };

/** Arrays for `count` Gaussians; shN is [count, coefficients, 3] of SH degrees 1 and up. Those of DIAL: null if absent. */
export function allocate(count, degree) {
  const coefficients = (degree + 1) ** 2 - 1;
  return {
    count, degree, coefficients, sigmaD: null, growthD: null, comments: [], notes: [],
    means: new Float32Array(3 * count), quats: new Float32Array(4 * count), logScales: new Float32Array(3 * count),
    opacityLogits: new Float32Array(count), sh0: new Float32Array(3 * count),
    shN: new Float32Array(3 * coefficients * count),
  };
}

export const SH_C0 = 0.28209479177387814;

/** The logit of `a`, clamped to [-40, 40], because a stored byte can mean 0 or 1. */
export const logit = (a) => Math.min(Math.max(Math.log(a) - Math.log1p(-a), -40), 40);

/** The unit quaternion whose component number `largest`, omitted from `three`, is the largest. */
export function smallestThree(largest, three) {
  const rest = Math.sqrt(Math.max(0, 1 - three.reduce((sum, value) => sum + value * value, 0)));
  return [...three.slice(0, largest), rest, ...three.slice(largest)];
}

/** The dial's settings, screen-space filter and calibration in our description of a file that is not a PLY; none in others. */
export function described(values, count) {
  if (!values) return {};
  const { attenuation, screen_filter: screenFilter = { variance: 0.3, compensate: false }, calibration } = values;
  const rows = calibration?.total === count ? calibration.rows.map(({ virtual_scale, kept, psnr }) => ({ virtual_scale, count: kept, psnr })) : [];
  return { ...(attenuation ? { settings: attenuation } : {}), screenFilter, calibration: rows };
}

function removals(masked, invalid, count) {
  const notes = masked ? [`${masked} of ${count} Gaussians are masked out by MaskGaussian and were removed`] : [];
  return invalid ? [...notes, `${invalid} of ${count} Gaussians cannot be drawn and were removed`] : notes;
}

const SHORTEST = 1e-15, LONGEST = 1e15; // quaternion (clod_adapter/_kernels)

/** Removes the rows that cannot be drawn: with a non-finite value, or a quaternion too short or long (io/ply/rows.py). */
export function removeInvalid(gaussians) {
  const { count, means, quats, logScales, opacityLogits, sh0, shN, coefficients, exists } = gaussians;
  const finite = (array, size, i) => {
    for (let k = size * i; k < size * (i + 1); k++) if (!Number.isFinite(array[k])) return false;
    return true;
  };
  let masked = 0;
  const keep = [], dial = Object.values(DIAL).filter((name) => gaussians[name]);
  for (let i = 0; i < count; i++) {
    if (exists && exists[i] === 0) {
      masked++;
      continue;
    }
    let square = 0;
    for (let k = 4 * i; k < 4 * i + 4; k++) square += quats[k] * quats[k];
    const rotated = square >= SHORTEST ** 2 && square <= LONGEST ** 2;
    const opaque = Number.isFinite(opacityLogits[i]) || opacityLogits[i] === Infinity;
    if (rotated && opaque && !(exists && Number.isNaN(exists[i])) && finite(means, 3, i) && finite(logScales, 3, i) && finite(sh0, 3, i)
      && finite(shN, 3 * coefficients, i) && dial.every((name) => Number.isFinite(gaussians[name][i]))) keep.push(i);
  }
  if (!keep.length) throw new Error("no Gaussian in it can be drawn: values are not finite or rotations are 0; export it again");
  if (keep.length === count) return gaussians;
  const pick = (array, size) => {
    const picked = new Float32Array(size * keep.length);
    keep.forEach((i, at) => picked.set(array.subarray(size * i, size * (i + 1)), size * at));
    return picked;
  };
  return {
    ...gaussians, count: keep.length, means: pick(means, 3), quats: pick(quats, 4), logScales: pick(logScales, 3),
    opacityLogits: pick(opacityLogits, 1), sh0: pick(sh0, 3), shN: pick(shN, 3 * coefficients),
    ...Object.fromEntries(dial.map((name) => [name, pick(gaussians[name], 1)])),
    notes: [...gaussians.notes, ...removals(masked, count - keep.length - masked, count)],
  };
}

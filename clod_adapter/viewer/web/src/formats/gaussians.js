// What every reader returns: values as Inria's PLY stores them (logit opacities, logarithmic scales, wxyz), float32.

/** Room for `count` Gaussians; `coefficients` are those of the higher bands, as shN [count, coefficients, 3]. */
export function blank(count, degree) {
  const coefficients = (degree + 1) ** 2 - 1;
  return {
    count, degree, coefficients, sigma: null, comments: [], notes: [],
    means: new Float32Array(3 * count), quats: new Float32Array(4 * count), logScales: new Float32Array(3 * count),
    opacityLogits: new Float32Array(count), sh0: new Float32Array(3 * count),
    shN: new Float32Array(3 * coefficients * count),
  };
}

export const SH_C0 = 0.28209479177387814;

/** In [-40, 40], as bytes say 0 and 1 exactly. */
export const logit = (a) => Math.min(Math.max(Math.log(a) - Math.log1p(-a), -40), 40);

/** The unit quaternion of four whose `largest` component is left out of `three`. */
export function smallestThree(largest, three) {
  const rest = Math.sqrt(Math.max(0, 1 - three.reduce((sum, value) => sum + value * value, 0)));
  return [...three.slice(0, largest), rest, ...three.slice(largest)];
}

/** Without the rows that no picture can use: a value that is not finite, or a rotation of zero (io/ply.py). */
export function usable(gaussians) {
  const { count, means, quats, logScales, opacityLogits, sh0, shN, coefficients, sigma } = gaussians;
  const finite = (array, size, i) => {
    for (let k = size * i; k < size * (i + 1); k++) if (!Number.isFinite(array[k])) return false;
    return true;
  };
  const keep = [];
  for (let i = 0; i < count; i++) {
    const turned = quats[4 * i] || quats[4 * i + 1] || quats[4 * i + 2] || quats[4 * i + 3];
    const opaque = Number.isFinite(opacityLogits[i]) || opacityLogits[i] === Infinity;
    if (turned && opaque && finite(means, 3, i) && finite(quats, 4, i) && finite(logScales, 3, i) && finite(sh0, 3, i)
      && finite(shN, 3 * coefficients, i) && (!sigma || Number.isFinite(sigma[i]))) keep.push(i);
  }
  if (!keep.length) throw new Error("there is no usable Gaussian in it; export it again");
  if (keep.length === count) return gaussians;
  const pick = (array, size) => {
    const picked = new Float32Array(size * keep.length);
    keep.forEach((i, at) => picked.set(array.subarray(size * i, size * (i + 1)), size * at));
    return picked;
  };
  return {
    ...gaussians, count: keep.length, means: pick(means, 3), quats: pick(quats, 4), logScales: pick(logScales, 3),
    opacityLogits: pick(opacityLogits, 1), sh0: pick(sh0, 3), shN: pick(shN, 3 * coefficients),
    sigma: sigma && pick(sigma, 1),
    notes: [...gaussians.notes, `${count - keep.length} of ${count} Gaussians cannot be drawn and are left out`],
  };
}

// The dial's equation in float64, as in clod_adapter/equation/attenuation.py. At the dial value s a Gaussian is kept
// iff d s < sigma_d or d s = 0, with d = |mean - eye| / D: below its extinction scale sigma_d / d.

/** The extinction scale of a Gaussian at a squared distance, world units^2; `unit` is D. */
export const extinctionScale = (sigma, squared, unit) =>
  squared === 0 ? Infinity : (Math.max(sigma, 0) * unit) / Math.sqrt(squared);

/** Whether a dial value keeps a Gaussian with this extinction scale. */
export const isKept = (scale, dial) => dial < scale || dial === 0;

/** The extinction scales of all Gaussians, seen from an eye. */
export function extinctionScales(means, sigma, eye, unit) {
  return Float64Array.from(sigma, (reach, i) => {
    const at = 3 * i, x = means[at] - eye[0], y = means[at + 1] - eye[1], z = means[at + 2] - eye[2];
    return extinctionScale(reach, x * x + y * y + z * z, unit);
  });
}

export const countKept = (scales, dial) => scales.reduce((kept, scale) => kept + isKept(scale, dial), 0);

/** The smallest dial value in [1, largest] that keeps at most `target` Gaussians, else the largest one. */
export function dialForCount(scales, target, largest) {
  const firstToGo = scales.toSorted().at(-1 - target) ?? 1;
  return Math.min(Math.max(firstToGo, 1), largest);
}

/** r, in units of D: the distance from which on scales grow. */
export const growthStart = ({ reference_distance: reference, scene_distance: unit }) => (reference ? reference / unit : 1);

/** The factor of the scales of a kept Gaussian. `magnification`: s d / r. */
export const growthFactor = (growth, magnification) =>
  Math.exp(Math.min(Math.max(growth * Math.log(Math.min(Math.max(magnification, 1), 3e38)), -20), 20));

// The dial's equation in float64, as in clod_adapter/equation/attenuation.py. A Gaussian is kept at the dial values of a
// band: from `begin`, which is 0 for all but far Gaussians, to `end`, where its reach, or near_distance, is d s.

const BEGIN = Math.sqrt(11 / 12); // far Gaussians begin at this share of near_distance

/** The dial value from which on a Gaussian is kept at a squared distance, world units^2. */
export const beginOf = (sigma, squared, { near_distance: near = 0 }) =>
  near > 0 && sigma > 0 ? (BEGIN * near) / Math.sqrt(squared) : 0;

/** Its extinction scale, up to which it is kept. */
export function endOf(sigma, squared, { near_distance: near = 0, scene_distance: unit }) {
  const reach = near > 0 && sigma <= 0 ? near : Math.max(sigma, 0) * unit;
  return squared === 0 ? Infinity : reach / Math.sqrt(squared);
}

/** Whether a dial value keeps a Gaussian with this band. */
export const isKept = (begin, end, dial) => (begin === 0 ? dial < end || dial === 0 : begin < dial && dial < end);

/** How many are drawn at s = 0: all, or the near ones. */
export const wholeCount = (count, sigma, { near_distance: near = 0 }) =>
  near > 0 ? sigma.reduce((whole, reach) => whole + (reach <= 0), 0) : count;

/** The bands of all Gaussians, {begins, ends}, seen from an eye. */
export function bandsOf(means, sigma, eye, settings) {
  const begins = new Float64Array(sigma.length), ends = new Float64Array(sigma.length);
  for (let i = 0, at = 0; i < sigma.length; i++, at += 3) {
    const x = means[at] - eye[0], y = means[at + 1] - eye[1], z = means[at + 2] - eye[2], squared = x * x + y * y + z * z;
    begins[i] = beginOf(sigma[i], squared, settings);
    ends[i] = endOf(sigma[i], squared, settings);
  }
  return { begins, ends };
}

export const countKept = ({ begins, ends }, dial) =>
  ends.reduce((kept, end, i) => kept + isKept(begins[i], end, dial), 0);

/** The smallest dial value in [1, largest] that keeps at most `target` Gaussians, else the largest one. */
export function dialForCount(bands, target, largest) {
  if (countKept(bands, 1) <= target) return 1;
  if (bands.begins.every((begin) => begin === 0)) return Math.min(bands.ends.toSorted().at(-1 - target), largest);
  let low = 1, high = largest; // where far Gaussians begin as near ones end, the count has no such order
  while (high / low > 1 + 1e-9) {
    const middle = Math.sqrt(low * high);
    if (countKept(bands, middle) > target) low = middle;
    else high = middle;
  }
  return high;
}

/** r, in units of D: the distance from which on scales grow. */
export const growthStart = ({ reference_distance: reference, scene_distance: unit }) => (reference ? reference / unit : 1);

/** The factor of the scales of a kept Gaussian. `magnification`: s d / r. */
export const growthFactor = (growth, magnification) =>
  Math.exp(Math.min(Math.max(growth * Math.log(Math.min(Math.max(magnification, 1), 3e38)), -20), 20));

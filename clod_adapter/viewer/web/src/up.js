// The up axis of a scene: that of its photographs' cameras, else that of its Gaussians.
import { add, dot, scaled, unit } from "./vector.js";

const Y_DOWN = [0, -1, 0]; // COLMAP's y axis points down
const FLAT = Math.log(2); // a flat Gaussian's least scale is at most half the next one
const NEAR = Math.cos(Math.PI / 15), BESIDE = Math.cos(Math.PI / 9), APART = Math.cos(Math.PI / 6);
const SURE = 3; // standard deviations of a count
const LEVEL = 0.3, CLEAR = 0.5; // of an axis's y component, below which y is no sign of down; standard deviations of height
const DIRECTIONS = Array.from({ length: 400 }, (_, k) => { // of a hemisphere, on a spiral
  const z = 1 - (k + 0.5) / 400, angle = Math.PI * (1 + Math.sqrt(5)) * k, r = Math.sqrt(1 - z * z);
  return [r * Math.cos(angle), r * Math.sin(angle), z];
});

/** The mean up vector of the photographs' cameras; null without these, or where their mean is 0. */
export function upOfCameras(cameras) {
  const sum = cameras.reduce((total, { viewmat, placed }) => (placed ? total : add(total, viewmat[1].slice(0, 3), -1)), [0, 0, 0]);
  return Math.hypot(...sum) > 1e-3 * cameras.length ? unit(sum) : null;
}

/** The direction that most flat Gaussians among these rows face, by opacity: they are a ground, or a table. It points to the
 *  side where the others are or, where these are on both sides, towards minus y. Minus y where about as many face another
 *  direction. */
export function upOfGaussians({ means, quats, logScales, opacityLogits }, rows) {
  const all = rows.map((i) => {
    const scales = [0, 1, 2].map((k) => logScales[3 * i + k]), least = Math.min(...scales);
    return {
      mean: [means[3 * i], means[3 * i + 1], means[3 * i + 2]], opacity: 1 / (1 + Math.exp(-opacityLogits[i])),
      normal: axisOf(quats.subarray(4 * i, 4 * i + 4), scales.indexOf(least)), isFlat: scales.filter((scale) => scale < least + FLAT).length === 1,
    };
  });
  const flat = all.filter(({ isFlat }) => isFlat), isAlong = (a, b, least) => Math.abs(dot(a, b)) > least;
  const counts = DIRECTIONS.map((axis) => flat.reduce((sum, { normal, opacity }) => sum + (isAlong(normal, axis, NEAR) ? opacity : 0), 0));
  const most = Math.max(...counts);
  let axis = DIRECTIONS[counts.indexOf(most)];
  const second = Math.max(...counts.filter((_, k) => !isAlong(DIRECTIONS[k], axis, APART)));
  if (!(most - second > SURE * Math.sqrt(most))) return Y_DOWN;
  for (let pass = 0; pass < 3; pass++) {
    const beside = flat.filter(({ normal }) => isAlong(normal, axis, BESIDE));
    axis = unit(beside.reduce((sum, { normal, opacity }) => add(sum, normal, Math.sign(dot(normal, axis)) * opacity), [0, 0, 0]));
  }
  const isGround = ({ isFlat, normal }) => isFlat && isAlong(normal, axis, NEAR), height = heights(axis);
  const [ground, others, every] = [all.filter(isGround), all.filter((each) => !isGround(each)), all].map(height);
  const above = (others.mean - ground.mean) / every.deviation, bySide = Math.abs(above) > CLEAR || Math.abs(axis[1]) < LEVEL;
  return scaled(axis, (bySide ? above : -axis[1]) < 0 ? -1 : 1);
}

/** Mean and standard deviation of Gaussians along an axis, by opacity. */
const heights = (axis) => (gaussians) => {
  const moment = (of) => gaussians.reduce((sum, each) => sum + each.opacity * of(dot(each.mean, axis)), 0);
  const total = moment(() => 1), mean = moment((h) => h) / total;
  return { mean, deviation: Math.sqrt(moment((h) => (h - mean) ** 2) / total) };
};

/** A column of the rotation matrix of a quaternion. */
function axisOf(quaternion, column) {
  const norm = Math.hypot(...quaternion), [w, x, y, z] = Array.from(quaternion, (value) => value / norm);
  if (column === 0) return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
  if (column === 1) return [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
  return [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
}

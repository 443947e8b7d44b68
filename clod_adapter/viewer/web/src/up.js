// The up axis of a scene: that of its cameras, else that of its Gaussians.
import { add, cross, dot, row, unit } from "./vector.js";

const Y_DOWN = [0, -1, 0]; // COLMAP's y axis points down
const FLAT = 0.5, TERRAIN = 0.1; // variance across a scene over that along it, below which it is one with a ground, and a terrain
const TILT = Math.cos(Math.PI / 4); // a ground of a scene that is no terrain has its normal within this of the y axis

/** The mean up vector of the cameras; null without cameras, or where their mean is 0. */
export function upOfCameras(cameras) {
  const sum = cameras.reduce((total, { viewmat }) => add(total, viewmat[1].slice(0, 3), -1), [0, 0, 0]);
  return Math.hypot(...sum) > 1e-3 * cameras.length ? unit(sum) : null;
}

/** The normal of the plane along which most of the `points` lie, [x, y, z] each: towards minus y, as COLMAP's first camera
 *  has it, or of a terrain towards the side with the longer tail. Minus y where there is no such plane. */
export function upOfPoints(points) {
  const centre = scaledSum(points, () => 1 / points.length);
  const covariance = new Float64Array(9);
  for (const point of points) {
    const d = add(point, centre, -1);
    for (let i = 0; i < 9; i++) covariance[i] += (d[Math.floor(i / 3)] * d[i % 3]) / points.length;
  }
  const { values, vectors } = eigen(covariance), normal = row(vectors, 0), flatness = values[0] / values[1];
  const level = Math.abs(normal[1]) > TILT && flatness < FLAT;
  if (!(level || flatness < TERRAIN)) return Y_DOWN;
  const towards = level ? -normal[1] : tail(points.map((point) => dot(add(point, centre, -1), normal)));
  return normal.map((v) => (towards < 0 ? -v : v));
}

/** The sign of the third moment. */
const tail = (values) => Math.sign(values.reduce((sum, value) => sum + value ** 3, 0)) || 1;

const scaledSum = (points, weight) => points.reduce((sum, point) => add(sum, point, weight(point)), [0, 0, 0]);

/** Eigenvalues of a symmetric matrix, ascending, and the unit eigenvectors as rows (Jacobi's rotations). */
function eigen(matrix) {
  const a = Float64Array.from(matrix), v = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (let sweep = 0; sweep < 20; sweep++) for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
    const off = a[3 * p + q];
    if (Math.abs(off) < 1e-300) continue;
    const theta = (a[4 * q] - a[4 * p]) / (2 * off), t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.hypot(theta, 1));
    const c = 1 / Math.hypot(t, 1), s = t * c;
    for (const [m, stride, step] of [[a, 3, 1], [a, 1, 3], [v, 1, 3]]) {
      for (let k = 0; k < 3; k++) {
        const [i, j] = [stride * k + step * p, stride * k + step * q], [x, y] = [m[i], m[j]];
        [m[i], m[j]] = [c * x - s * y, s * x + c * y];
      }
    }
  }
  const order = [0, 1, 2].sort((i, j) => a[4 * i] - a[4 * j]);
  return { values: order.map((i) => a[4 * i]), vectors: order.flatMap((i) => [v[3 * i], v[3 * i + 1], v[3 * i + 2]]) };
}

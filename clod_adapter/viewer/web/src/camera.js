// Where the page looks from: a pinhole in OpenCV axes, as clod_adapter/cameras.py has it, that orbits and flies.
import { add, cross, dot, row, turned, unit } from "./vector.js";

const FIELD = (50 * Math.PI) / 180; // across the shorter side, where no camera says
const NEAR = 0.01; // of the near plane, world units, as clod_adapter/cameras.py
const STEEPEST = 0.995; // |forward . up|: orbiting stops before it looks straight up or down

export function createCamera() {
  const camera = {
    rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], // rows: right, down, forward, in world axes
    eye: [0, 0, 0], up: [0, -1, 0], reach: 1, // reach: how far ahead the point lies that orbiting turns about
    near: NEAR,
    field: FIELD, // of view across the canvas's shorter side, radians
    exact: null, // {fx, fy, cx, cy, width, height} while a camera is reproduced to the pixel

    /** What the renderer and the worker take, for a canvas of so many pixels. */
    view(width, height) {
      const { rotation, eye, near, exact } = camera;
      if (exact) return { rotation: [...rotation], eye: [...eye], near, ...exact };
      const f = Math.min(width, height) / 2 / Math.tan(camera.field / 2);
      return { rotation: [...rotation], eye: [...eye], near, fx: f, fy: f, cx: width / 2, cy: height / 2, width, height };
    },

    /** Stands exactly where a camera of the configuration stands. */
    set({ viewmat, K, width, height, near }) {
      camera.rotation = [0, 1, 2].flatMap((k) => viewmat[k].slice(0, 3));
      const t = [0, 1, 2].map((k) => viewmat[k][3]);
      camera.eye = [0, 1, 2].map((k) => -dot([0, 1, 2].map((j) => viewmat[j][k]), t));
      camera.near = near > 0 ? near : NEAR;
      camera.exact = { fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width, height };
      const [side, f] = width < height ? [width, K[0][0]] : [height, K[1][1]];
      camera.field = 2 * Math.atan(side / 2 / f);
    },

    place(eye, forward) {
      const right = unit(cross(forward, camera.up));
      camera.rotation = [...right, ...cross(forward, right), ...forward];
      camera.eye = eye;
      camera.exact = null;
    },

    /** Turns by two angles: about the point ahead (orbit), or on the spot (fly). */
    turn(sideways, upwards, orbiting) {
      camera.exact = null;
      const pivot = add(camera.eye, row(camera.rotation, 2), camera.reach);
      const axes = [0, 1, 2].map((k) => turned(row(camera.rotation, k), camera.up, sideways));
      const tilted = axes.map((axis) => turned(axis, axes[0], upwards));
      const steep = Math.abs(dot(tilted[2], camera.up));
      const allowed = steep < STEEPEST || steep < Math.abs(dot(axes[2], camera.up));
      camera.rotation = (allowed ? tilted : axes).flatMap((axis) => unit(axis));
      if (orbiting) camera.eye = add(pivot, row(camera.rotation, 2), -camera.reach);
    },

    /** Moves along right, down and forward, world units. */
    move(right, down, forward) {
      camera.exact = null;
      [right, down, forward].forEach((by, k) => { camera.eye = add(camera.eye, row(camera.rotation, k), by); });
    },

    /** Nears the point ahead by a factor. */
    zoom(factor) {
      camera.exact = null;
      const reach = camera.reach * factor;
      camera.eye = add(camera.eye, row(camera.rotation, 2), camera.reach - reach);
      camera.reach = reach;
    },

    /** Turns about what the photographs look at, or the bulk of the Gaussians; `cameras` say which way is up. */
    fit(extent, cameras) {
      const { centre, radius } = extent;
      if (cameras.length) {
        const ups = cameras.map(({ viewmat }) => viewmat[1].slice(0, 3));
        const up = ups.reduce((sum, down) => add(sum, down, -1), [0, 0, 0]);
        if (Math.hypot(...up) > 1e-3 * cameras.length) camera.up = unit(up);
        camera.set(cameras[0]);
        camera.reach = reachOf(cameras) ?? Math.max(dot(row(camera.rotation, 2), add(centre, camera.eye, -1)), 0.1 * radius);
        return;
      }
      camera.up = [0, -1, 0]; // COLMAP's y points down, and so do the files trained on it
      camera.near = Math.min(NEAR, 1e-3 * radius);
      camera.field = FIELD;
      camera.reach = (1.1 * radius) / Math.tan(FIELD / 2);
      const forward = unit([0, 0.25, 1]);
      camera.place(add(centre, forward, -camera.reach), forward);
    },
  };
  return camera;
}

/** How far ahead of the first camera all look, in the least squares of their axes; null where they do not meet. */
function reachOf(cameras) {
  const normal = new Float64Array(9), target = [0, 0, 0];
  const poses = cameras.map(({ viewmat }) => {
    const r = viewmat.map((line) => line.slice(0, 3)), t = [0, 1, 2].map((k) => viewmat[k][3]);
    return { forward: r[2], eye: [0, 1, 2].map((k) => -(r[0][k] * t[0] + r[1][k] * t[1] + r[2][k] * t[2])) };
  });
  for (const { forward, eye } of poses) {
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) {
      const value = (i === j ? 1 : 0) - forward[i] * forward[j];
      normal[3 * i + j] += value;
      target[i] += value * eye[j];
    }
  }
  const [a, b, c] = [0, 1, 2].map((k) => row(normal, k)), det = dot(a, cross(b, c));
  if (!(det > 1e-6 * cameras.length ** 3)) return null;
  const rows = [cross(b, c), cross(c, a), cross(a, b)]; // columns of the inverse, times det
  const point = rows.reduce((sum, column, k) => add(sum, column, target[k] / det), [0, 0, 0]);
  const ahead = dot(poses[0].forward, add(point, poses[0].eye, -1));
  return ahead > 0 ? ahead : null;
}

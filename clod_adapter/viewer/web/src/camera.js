// A pinhole camera in OpenCV axes, as in clod_adapter/cameras.py, that orbits and flies.
import { add, cross, dot, row, rotated, unit } from "./vector.js";

const DEFAULT_FOV = (50 * Math.PI) / 180; // across the shorter side, without a configured camera
const NEAR = 0.01; // depth of the near plane, world units, as in clod_adapter/cameras.py
const MAX_PITCH = 0.995; // of |forward . up|: orbiting stops before it looks straight up or down

export function createCamera() {
  const camera = {
    rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], // rows: right, down, forward, in world axes
    eye: [0, 0, 0], up: [0, -1, 0], distance: 1, // distance: from the eye to the pivot, the point ahead that orbiting rotates about
    near: NEAR,
    fov: DEFAULT_FOV, // across the canvas's shorter side, radians
    intrinsics: null, // {fx, fy, cx, cy, width, height} of a camera to reproduce exactly, until the view moves

    /** The view that the renderer and the worker take, for a canvas of this size in pixels. */
    view(width, height) {
      const { rotation, eye, near, intrinsics } = camera;
      if (intrinsics) return { rotation: [...rotation], eye: [...eye], near, ...intrinsics };
      const f = Math.min(width, height) / 2 / Math.tan(camera.fov / 2);
      return { rotation: [...rotation], eye: [...eye], near, fx: f, fy: f, cx: width / 2, cy: height / 2, width, height };
    },

    /** Takes pose and intrinsics of a camera of the configuration. */
    set({ viewmat, K, width, height, near }) {
      camera.rotation = [0, 1, 2].flatMap((k) => viewmat[k].slice(0, 3));
      const t = [0, 1, 2].map((k) => viewmat[k][3]);
      camera.eye = [0, 1, 2].map((k) => -dot([0, 1, 2].map((j) => viewmat[j][k]), t));
      camera.near = near > 0 ? near : NEAR;
      camera.intrinsics = { fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width, height };
      const [side, f] = width < height ? [width, K[0][0]] : [height, K[1][1]];
      camera.fov = 2 * Math.atan(side / 2 / f);
    },

    /** Puts the camera at `eye` with its axis along the unit vector `forward`. */
    place(eye, forward) {
      const right = unit(cross(forward, camera.up));
      camera.rotation = [...right, ...cross(forward, right), ...forward];
      camera.eye = eye;
      camera.intrinsics = null;
    },

    /** Rotates by two angles, radians: about the pivot (orbit), or about the eye (fly). */
    rotate(yaw, pitch, orbiting) {
      camera.intrinsics = null;
      const pivot = add(camera.eye, row(camera.rotation, 2), camera.distance);
      const axes = [0, 1, 2].map((k) => rotated(row(camera.rotation, k), camera.up, yaw));
      const tilted = axes.map((axis) => rotated(axis, axes[0], pitch));
      const pitched = Math.abs(dot(tilted[2], camera.up));
      const allowed = pitched < MAX_PITCH || pitched < Math.abs(dot(axes[2], camera.up));
      camera.rotation = (allowed ? tilted : axes).flatMap((axis) => unit(axis));
      if (orbiting) camera.eye = add(pivot, row(camera.rotation, 2), -camera.distance);
    },

    /** Moves along right, down and forward, world units. */
    move(right, down, forward) {
      camera.intrinsics = null;
      [right, down, forward].forEach((amount, k) => { camera.eye = add(camera.eye, row(camera.rotation, k), amount); });
    },

    /** Multiplies the distance to the pivot by a factor. */
    zoom(factor) {
      camera.intrinsics = null;
      const distance = camera.distance * factor;
      camera.eye = add(camera.eye, row(camera.rotation, 2), camera.distance - distance);
      camera.distance = distance;
    },

    /** Shows the first of `cameras`, with the pivot where they look and their mean up vector; without cameras, the Gaussians. */
    fit(extent, cameras) {
      const { centre, radius } = extent;
      if (cameras.length) {
        const ups = cameras.map(({ viewmat }) => viewmat[1].slice(0, 3));
        const up = ups.reduce((sum, down) => add(sum, down, -1), [0, 0, 0]);
        if (Math.hypot(...up) > 1e-3 * cameras.length) camera.up = unit(up);
        camera.set(cameras[0]);
        camera.distance = focusDistance(cameras) ?? Math.max(dot(row(camera.rotation, 2), add(centre, camera.eye, -1)), 0.1 * radius);
        return;
      }
      camera.up = [0, -1, 0]; // COLMAP's y axis points down
      camera.near = Math.min(NEAR, 1e-3 * radius);
      camera.fov = DEFAULT_FOV;
      camera.distance = (1.1 * radius) / Math.tan(DEFAULT_FOV / 2);
      const forward = unit([0, 0.25, 1]);
      camera.place(add(centre, forward, -camera.distance), forward);
    },
  };
  return camera;
}

/** Depth in the first camera of the point nearest to all axes (least squares); null where there is none in front of it. */
function focusDistance(cameras) {
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

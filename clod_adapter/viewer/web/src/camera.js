// A pinhole camera in OpenCV axes, as in clod_adapter/cameras.py, that orbits and flies.
import { add, cross, dot, row, rotated, unit } from "./vector.js";

const DEFAULT_FOV = (50 * Math.PI) / 180; // without a configured camera
const NEAR = 0.01; // depth of the near plane, world units, as in clod_adapter/cameras.py
const BESIDE = 0.5, ALIKE = 0.7; // of isNear: of the distance; cosine
const MAX_PITCH = 0.995; // of |forward . up|: orbiting stops before it looks straight up or down

export function createCamera() {
  const camera = {
    rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], // rows: right, down, forward, in world axes
    eye: [0, 0, 0], up: [0, -1, 0], distance: 1, reach: 1, // distance: from the eye to the pivot, the point ahead that orbiting rotates about
    near: NEAR,
    fov: DEFAULT_FOV, aspect: 1, // of the picture that the canvas shows in full: across its shorter side, radians; width over height
    panel: [0, 0], // shares of the canvas that the panel covers from the left and from the bottom, with what is beside it
    intrinsics: null, // {fx, fy, cx, cy, width, height} of a camera to reproduce exactly, until the view moves

    /** The view that the renderer and the worker take, for a canvas of this size in pixels. */
    view(width, height) {
      const { rotation, eye, near, intrinsics } = camera;
      if (intrinsics) return { rotation: [...rotation], eye: [...eye], near, ...intrinsics };
      const { side, cx, cy } = placed(camera.aspect, width, height, camera.panel), f = side / 2 / Math.tan(camera.fov / 2);
      return { rotation: [...rotation], eye: [...eye], near, fx: f, fy: f, cx, cy, width, height };
    },

    /** Takes pose and intrinsics of a camera of the configuration; one that was placed is levelled. */
    set({ viewmat, K, width, height, near, placed = false }) {
      camera.rotation = [0, 1, 2].flatMap((k) => viewmat[k].slice(0, 3));
      camera.eye = axisOf(viewmat).eye;
      camera.near = near > 0 ? near : NEAR;
      camera.intrinsics = { fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width, height };
      const [side, f] = width < height ? [width, K[0][0]] : [height, K[1][1]];
      camera.fov = 2 * Math.atan(side / 2 / f);
      camera.aspect = width / height;
      const forward = row(camera.rotation, 2);
      if (placed && Math.abs(dot(forward, camera.up)) < MAX_PITCH) camera.place(camera.eye, forward);
    },

    /** Pose and field of view, as an animation takes them (motion.js). */
    get pose() {
      const { rotation, eye, fov, aspect, distance } = camera;
      return { forward: row(rotation, 2), down: row(rotation, 1), eye, fov, aspect, distance };
    },
    set pose({ forward, down, ...rest }) {
      const ahead = unit(forward), right = unit(cross(down, ahead));
      Object.assign(camera, rest, { rotation: [...right, ...cross(ahead, right), ...ahead], intrinsics: null });
    },

    /** Sets the axis that orbiting rotates about, and levels the view. */
    setUp(up) {
      camera.up = unit(up);
      const pivot = add(camera.eye, row(camera.rotation, 2), camera.distance), before = row(camera.rotation, 2);
      const climb = dot(before, camera.up), forward = climb > -MAX_PITCH && climb < 0.5 ? before : lookingDown(camera.up);
      camera.place(add(pivot, forward, -camera.distance), forward);
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

    /** Whether one of the cameras is near and looks the same way, by the distance to the pivot when they were fitted. */
    isNear(cameras) {
      return cameras.some(({ viewmat }) => {
        const { eye, forward } = axisOf(viewmat);
        return Math.hypot(...add(camera.eye, eye, -1)) < BESIDE * camera.reach && dot(forward, row(camera.rotation, 2)) > ALIKE;
      });
    },

    /** Shows the first of `cameras`, with the pivot where they look; without cameras, all Gaussians of the extent. */
    fit(extent, cameras, up) {
      const { centre, radius } = extent;
      camera.up = up;
      if (cameras.length) {
        camera.set(cameras[0]);
        camera.distance = focusDistance(cameras) ?? Math.max(dot(row(camera.rotation, 2), add(centre, camera.eye, -1)), 0.1 * radius);
        camera.reach = camera.distance;
        return;
      }
      camera.near = Math.min(NEAR, 1e-3 * radius);
      [camera.fov, camera.aspect] = [DEFAULT_FOV, 1];
      camera.distance = radius / Math.sin(DEFAULT_FOV / 2);
      const forward = lookingDown(up);
      camera.place(add(centre, forward, -camera.distance), forward);
    },
  };
  return camera;
}

/** The shorter side and the centre of a picture in a canvas, the largest that the panel does not hide: in the middle, else
 *  in the part to the right of the panel or in that above it. */
function placed(aspect, width, height, [left, bottom]) {
  const within = (w, h) => ({ side: Math.min(w / Math.max(aspect, 1), h * Math.min(aspect, 1)), cx: width - w / 2, cy: h / 2 });
  const middle = within(width, height), { side } = middle;
  const hidden = width - side * Math.max(aspect, 1) < 2 * left * width && height - side / Math.min(aspect, 1) < 2 * bottom * height;
  if (!hidden) return middle;
  const [beside, above] = [within(width * (1 - left), height), within(width, height * (1 - bottom))];
  return beside.side > above.side ? beside : above;
}

/** Along the z axis, or y where z is up, and down by 27 degrees. */
function lookingDown(up) {
  const axis = Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0];
  return unit(add(unit(add(axis, up, -dot(axis, up))), up, -0.5));
}

/** The optical axis of a camera of the configuration: {eye, forward}. */
function axisOf(viewmat) {
  const r = viewmat.map((line) => line.slice(0, 3)), t = [0, 1, 2].map((k) => viewmat[k][3]);
  return { forward: r[2], eye: [0, 1, 2].map((k) => -(r[0][k] * t[0] + r[1][k] * t[1] + r[2][k] * t[2])) };
}

/** Depth in the first camera of the point nearest to all axes (least squares); null where there is none in front of it. */
function focusDistance(cameras) {
  const normal = new Float64Array(9), target = [0, 0, 0], poses = cameras.map(({ viewmat }) => axisOf(viewmat));
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

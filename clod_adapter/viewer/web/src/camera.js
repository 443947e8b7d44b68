// A pinhole camera in OpenCV axes, as in clod_adapter/cameras.py, that orbits and flies.
import { elements } from "./page.js";
import { add, cross, dot, row, rotated, scaled, unit } from "./vector.js";

const DEFAULT_FOV = (50 * Math.PI) / 180; // without a configured camera
const NEAR = 0.01; // depth of the near plane, world units, as in clod_adapter/cameras.py
const BESIDE = 0.5, ALIKE = 0.7; // of isNear: of the distance to the pivot; cosine
const MAX_PITCH = 0.995; // of |forward . up|: orbiting stops before it looks straight up or down

export const camera = {
  rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], // rows: right, down, forward, in world axes
  eye: [0, 0, 0], up: [0, -1, 0], near: NEAR,
  distance: 1, reach: 1, // from the eye to the pivot, the point ahead that orbiting rotates about; when last fitted
  fov: DEFAULT_FOV, aspect: 1, // of the picture: across its shorter side, radians; width over height
  intrinsics: null, // {fx, fy, cx, cy, width, height} of a camera to reproduce exactly, until the view moves
};

const forward = () => row(camera.rotation, 2);
const pivot = () => add(camera.eye, forward(), camera.distance);

let box = null; // the panel's rectangle when the picture was placed: a note below it moves nothing

export function findPanel() {
  box = elements.panel.getBoundingClientRect();
}

/** The view for a canvas of this size in pixels, with the picture as large as it can be beside the panel or above it. */
export function viewOf(width, height) {
  const { rotation, eye, near, intrinsics, fov, aspect } = camera;
  if (intrinsics) return { rotation, eye, near, ...intrinsics };
  const within = (w, h) => ({ side: Math.min(w / Math.max(aspect, 1), h * Math.min(aspect, 1)), cx: width - w / 2, cy: h / 2 });
  const beside = within(width * (1 - box.right / innerWidth), height);
  const above = within(width, box.width ? height * Math.max(box.top / innerHeight, 0.5) : height);
  const { side, cx, cy } = beside.side > above.side ? beside : above, f = side / 2 / Math.tan(fov / 2);
  return { rotation, eye, near, fx: f, fy: f, cx, cy, width, height };
}

export function setPose({ forward: ahead, down, ...rest }) {
  const axis = unit(ahead), right = unit(cross(down, axis));
  Object.assign(camera, rest, { rotation: [...right, ...cross(axis, right), ...axis], intrinsics: null });
}

/** The pose of a camera of the configuration, without a pivot; one that was placed is levelled. */
export function poseOf({ viewmat, K, width, height, placed: level }) {
  const [right, down, ahead] = viewmat.map((line) => line.slice(0, 3)), t = viewmat.map((line) => line[3]);
  const eye = scaled([0, 1, 2].map((k) => right[k] * t[0] + down[k] * t[1] + ahead[k] * t[2]), -1);
  const fov = 2 * Math.atan(width < height ? width / 2 / K[0][0] : height / 2 / K[1][1]);
  const levelled = level && Math.abs(dot(ahead, camera.up)) < MAX_PITCH;
  return { eye, forward: ahead, down: levelled ? scaled(camera.up, -1) : down, fov, aspect: width / height };
}

/** Takes the pose of a camera of the configuration. */
export function setCamera(entry) {
  setPose(poseOf(entry));
  camera.near = entry.near > 0 ? entry.near : NEAR;
}

/** Sets the axis that orbiting rotates about, and levels the view. */
export function setUp(up) {
  const centre = pivot();
  camera.up = unit(up);
  const ahead = Math.abs(dot(forward(), camera.up)) < 0.7 ? forward() : lookingDown(camera.up);
  setPose({ eye: add(centre, ahead, -camera.distance), forward: ahead, down: scaled(camera.up, -1) });
}

/** Rotates by two angles, radians: about the pivot (orbit), or about the eye (fly). */
export function rotate(yaw, pitch, orbiting) {
  const centre = pivot(), axes = [0, 1, 2].map((k) => rotated(row(camera.rotation, k), camera.up, yaw));
  const tilted = axes.map((axis) => rotated(axis, axes[0], pitch)), pitched = Math.abs(dot(tilted[2], camera.up));
  const allowed = pitched < MAX_PITCH || pitched < Math.abs(dot(axes[2], camera.up));
  camera.rotation = (allowed ? tilted : axes).flatMap((axis) => unit(axis));
  camera.intrinsics = null;
  if (orbiting) camera.eye = add(centre, forward(), -camera.distance);
}

/** Moves along right, down and forward, world units. */
export function move(...amounts) {
  camera.intrinsics = null;
  amounts.forEach((amount, k) => { camera.eye = add(camera.eye, row(camera.rotation, k), amount); });
}

/** Multiplies the distance to the pivot by a factor. */
export function zoom(factor) {
  move(0, 0, camera.distance * (1 - factor));
  camera.distance *= factor;
}

/** Shows the first of `cameras`, with the pivot where they look; without cameras, all Gaussians of the extent. */
export function fit({ centre, radius }, cameras, up) {
  camera.up = up;
  if (cameras.length) {
    setCamera(cameras[0]);
    camera.reach = camera.distance = Math.max(dot(forward(), add(focus(cameras, centre), camera.eye, -1)), 0.1 * radius);
    return;
  }
  const ahead = lookingDown(up), distance = radius / Math.sin(DEFAULT_FOV / 2);
  camera.near = Math.min(NEAR, 1e-3 * radius);
  const eye = add(centre, ahead, -distance);
  setPose({ eye, forward: ahead, down: scaled(up, -1), fov: DEFAULT_FOV, aspect: 1, distance });
}

/** Whether one of the cameras is near and looks the same way. */
export const isNear = (cameras) => cameras.map(poseOf).some(({ eye, forward: ahead }) =>
  Math.hypot(...add(camera.eye, eye, -1)) < BESIDE * camera.reach && dot(ahead, forward()) > ALIKE);

/** Along the z axis, or y where z is up, and down by 27 degrees. */
function lookingDown(up) {
  const axis = Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [0, 1, 0];
  return unit(add(unit(add(axis, up, -dot(axis, up))), up, -0.5));
}

/** The point nearest to the axes of all cameras, by steps from `point`: each is the mean of its projections on them. */
function focus(cameras, point) {
  const poses = cameras.map(poseOf);
  for (let step = 0; step < 100; step++) {
    const onAxes = poses.map(({ eye, forward: axis }) => add(eye, axis, dot(axis, add(point, eye, -1))));
    point = scaled(onAxes.reduce((sum, each) => add(sum, each)), 1 / cameras.length);
  }
  return point;
}

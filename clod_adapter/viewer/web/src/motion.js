// Animations of the camera: the path through the photographs, and the turntable. A pose is camera.pose.
import { add, cross, dot, scaled } from "./vector.js";

const TURN = 20; // seconds of the turntable's turn
const SPEED = 0.6; // of the path: radians, or distances to the pivot, a second
const STOPS = 40; // photographs of a path; of more, every second one or fewer is taken

/** Calls `onMove()` after every step. Only one animation runs; `onEnd()` is called when it ends or is stopped, and its
 *  `ended()` where it ends by itself. */
export function createMotion(camera, onMove, onEnd) {
  let step = null, start = 0, done = null;

  function run(next, ended = () => {}) {
    stop();
    [step, start, done] = [next, performance.now(), ended];
    requestAnimationFrame(tick);
  }

  function tick(now) {
    if (!step) return;
    const going = step(Math.max(now - start, 0) / 1000);
    onMove();
    if (going) return requestAnimationFrame(tick);
    const ended = done;
    stop();
    ended();
  }

  function stop() {
    if (!step) return;
    step = done = null;
    onEnd();
  }

  return {
    stop,
    get running() { return step !== null; },
    /** Rotates about the pivot; `turns`: how often. */
    turntable(turns, ended) {
      let before = 0;
      run((time) => {
        const now = Math.min(time, turns * TURN);
        camera.rotate((2 * Math.PI * (now - before)) / TURN, 0, true);
        before = now;
        return now < turns * TURN;
      }, ended);
    },
    /** Moves through the poses in their order, and calls `at(number)` for each pose that it passes. */
    path(poses, at, ended) {
      const stride = Math.ceil(poses.length / STOPS), stops = poses.flatMap((pose, number) => (number % stride ? [] : [{ ...pose, number }]));
      const times = stops.map(() => 0);
      for (let k = 1; k < stops.length; k++) times[k] = times[k - 1] + Math.max(far(stops[k - 1], stops[k]) / SPEED, 0.2);
      let passed = -1;
      run((time) => {
        const next = times.findIndex((each) => each > time), k = (next < 0 ? stops.length : next) - 1;
        if (k !== passed) at(stops[passed = k].number);
        const [a, b, c, d] = [k - 1, k, k + 1, k + 2].map((i) => stops[Math.min(Math.max(i, 0), stops.length - 1)]);
        camera.pose = blend([a, b, c, d], next < 0 ? 0 : (time - times[k]) / (times[next] - times[k]));
        return next >= 0;
      }, ended);
    },
  };
}

/** How far two poses are apart: the angle of their axes plus the distance in units of that to the pivot. */
const far = (a, b) =>
  Math.acos(Math.min(Math.max(dot(a.forward, b.forward), -1), 1)) + Math.hypot(...add(a.eye, b.eye, -1)) / Math.max(a.distance, 1e-9);

/** Catmull and Rom's spline through four poses, from the second (t = 0) to the third (t = 1). */
function blend(poses, t) {
  const weights = [-0.5 * t * (1 - t) ** 2, 1 + t * t * (1.5 * t - 2.5), t * (0.5 + t * (2 - 1.5 * t)), -0.5 * t * t * (1 - t)];
  const sum = (name) => poses.reduce((total, pose, k) => add(total, scaled(pose[name], weights[k])), [0, 0, 0]);
  const [, from, to] = poses, mix = (name) => from[name] + t * (to[name] - from[name]);
  let forward = sum("forward"), down = sum("down");
  if (Math.hypot(...cross(forward, down)) < 1e-3) ({ forward, down } = t < 0.5 ? from : to); // opposite axes have no middle
  return { eye: sum("eye"), forward, down, fov: mix("fov"), aspect: mix("aspect"), distance: mix("distance") };
}

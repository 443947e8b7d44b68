// Holding a frame rate: the law of clod_adapter/frame_rate.py, which has its equation, and its use for an animation.

export const NEWEST = 3, EXPONENT = 0.75;
const FRAMES = 20, NEAR = 0.15, DEAD_BAND = 0.03, OUTLIER = 3, STEP = Math.log(1.1);
const WORK = 0.8; // of a refresh interval is the budget of a frame; the browser composes the page in the rest
const REST = 80, UNCHANGED = 10; // after a change, at most REST frames are drawn for measuring; one that leaves the dial counts as UNCHANGED

/** Milliseconds of a frame's work at `fps` frames per second. */
export const budgetOf = (fps) => (WORK * 1000) / fps;

export function median(values) {
  const sorted = Float64Array.from(values).sort(), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

/** log of the time of a frame at the newest dial value over the budget. `frames`: [dial, milliseconds], oldest first. */
export function excess(frames, milliseconds) {
  const predicted = [];
  for (const [age, [dial, took]] of frames.slice(-FRAMES).reverse().entries()) {
    const distance = Math.log(dial / frames.at(-1)[0]);
    if (age >= NEWEST && Math.abs(distance) > NEAR) break;
    predicted.push(Math.log(Math.max(took / milliseconds, 1e-3)) + EXPONENT * distance);
  }
  const present = median(predicted), newest = median(predicted.slice(0, NEWEST));
  const noise = median(predicted.map((each) => Math.abs(each - present)));
  return Math.abs(newest - present) > Math.max(DEAD_BAND, OUTLIER * noise) ? newest : present;
}

/** The dial value of the next frame, in [1, maxSv]. */
export function nextDial(frames, milliseconds, maxSv) {
  const [dial] = frames.at(-1);
  if (frames.length < NEWEST) return dial;
  const off = excess(frames, milliseconds), step = Math.sign(off) * Math.min(Math.max(Math.abs(off) - DEAD_BAND, 0), STEP);
  return Math.min(Math.max(dial * Math.exp(step), 1), maxSv);
}

/** Follows frames of an animation that is drawn after changes only, at `fps` frames per second. */
export function createHold(fps) {
  const milliseconds = budgetOf(fps);
  let frames = [], left = REST;
  return {
    /** The displayed state has changed: further frames are measured. */
    wake() { left = REST; },
    get settled() { return left <= 0; },
    /** Takes a frame's time; returns the dial value of the next frame. A value below 1 stays while it is fast enough. */
    took(dial, took, maxSv) {
      frames = [...frames, [Math.max(dial, 1), took]].slice(-FRAMES);
      const held = nextDial(frames, milliseconds, maxSv), next = held > 1 ? held : Math.min(dial, 1);
      left -= next === dial ? UNCHANGED : 1;
      return next;
    },
    /** Whether frames at maxSv take longer than the budget, by a log of the ratio. */
    outOfReach: (maxSv, by = DEAD_BAND) => frames.slice(-NEWEST).every(([dial]) => dial === maxSv) && excess(frames, milliseconds) > by,
  };
}

// The time of a frame's work. The interval between two frames would not do: a display rounds it up to whole refreshes.

/** The milliseconds of `draw()` and its work on a WebGL 2 context, or a promise of them for a WebGPU device. */
export function timed(device, draw) {
  const start = performance.now();
  draw();
  if (device.queue) return device.queue.onSubmittedWorkDone().then(() => performance.now() - start);
  device.readPixels(0, 0, 1, 1, device.RGBA, device.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now() - start;
}

// The displayed state: one model at one dial value, or two images divided by a wipe. A frame is drawn only after a
// change, and while a held frame rate settles.
import { createHold } from "../../../../viewers/frame_rate.js";

const MIN_RESOLUTION = 0.5; // of the canvas's pixels per side, during motion on a slow device
const SLOW = 50, FAST = 25; // ms of a frame, above and below which the resolution during motion falls and rises
const IDLE = 180; // ms without motion, until a frame at full resolution

export function createStage(renderer, canvas, camera) {
  const state = { dial: 1, equation: true, wipe: null, steady: false }; // steady: full resolution in motion
  const listeners = { frame: () => {}, held: () => {}, error: () => {} };
  let main = makeSide(), second = makeSide(), model = null, base = null;
  let version = 0, drawnVersion = -1, resolution = 1, lastMotion = -Infinity, idleTimer = 0, frame = 0, frameMs = null;
  let newOrder = false, hold = null, warm = false; // warm: a frame has been drawn; the first one includes the compilation of the shaders
  const callbacks = []; // of whenDrawn

  function makeSide() {
    return { model: null, order: null, drawn: 0, sortedVersion: -1, kept: 0, distance: 1, from: 0, to: 1, busy: false };
  }

  /** Each side with the model, dial value and equation that it shows now; the right one has no dial. */
  function sides() {
    const left = { side: main, model, dial: state.dial, equation: state.equation };
    return state.wipe === null || !model ? [left] : [left, { side: second, model: base ?? model, dial: 1, equation: false }];
  }

  function size() {
    const scale = Math.min(window.devicePixelRatio || 1, 2) * (performance.now() - lastMotion < IDLE ? resolution : 1);
    return [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(Math.round(side * scale), 1));
  }

  function change({ moving = false } = {}) {
    version++;
    hold?.wake();
    if (moving && !state.steady) {
      lastMotion = performance.now();
      clearTimeout(idleTimer);
      idleTimer = setTimeout(() => resolution < 1 && change(), IDLE + 20);
    }
    schedule();
  }

  const isDrawn = () => drawnVersion === version && (!hold || hold.settled);

  function schedule(sorted = false) {
    newOrder ||= sorted;
    frame ||= requestAnimationFrame(() => draw().catch(listeners.error));
  }

  async function draw() {
    frame = 0;
    if (!model || renderer.gl.isContextLost()) return;
    const current = version, view = camera.view(...size()), shown = sides();
    for (const each of shown) requestOrder(each, view, current);
    if (shown.some(({ side, model: of }) => side.sortedVersion < 0 || side.model !== of)) return; // never sorted yet
    // Without motion, only the frame with the current order is drawn; during motion, an earlier order is used until then.
    const complete = shown.every(({ side }) => side.sortedVersion === current);
    if (!complete && !newOrder && performance.now() - lastMotion > IDLE) return;
    newOrder = false;
    shown.forEach(prepare);
    const ms = renderer.draw(shown.map(({ side }) => side), view);
    if (complete) drawnVersion = current;
    if (warm) took(ms);
    else schedule();
    warm = true;
    if (isDrawn()) for (const resolve of callbacks.splice(0)) resolve();
    listeners.frame();
  }

  function prepare({ side, dial, equation, model: of }, k, { length }) {
    const from = k === 0 ? 0 : state.wipe, to = length === 1 || k === 1 ? 1 : state.wipe;
    Object.assign(side, { dial, from, to, attenuated: equation && of.attenuation !== null });
  }

  /** Takes the milliseconds of a frame: for the resolution in motion, or the held frame rate, whose next frame has
   *  another dial value until it has settled. */
  function took(ms) {
    frameMs = ms;
    if (!hold && ms > SLOW) resolution = Math.max(resolution * 0.8, MIN_RESOLUTION);
    else if (!hold && ms < FAST) resolution = Math.min(resolution * 1.1, 1);
    if (!hold || hold.settled) return;
    const { dial } = state;
    state.dial = hold.took(dial, ms, model.max_sv);
    if (state.dial !== dial) version++;
    if (!isDrawn()) schedule();
    listeners.held(hold.outOfReach(model.max_sv), hold.excessAt(model.max_sv));
  }

  /** Requests the order for the current state, one at a time for each side. */
  async function requestOrder({ side, model: of, dial, equation }, view, current) {
    if (side.busy || (side.sortedVersion === current && side.model === of)) return;
    side.busy = true;
    try {
      await of.order({ view, dial, equation }, ({ rows, drawn: count, kept, distance }) => {
        if (of.destroyed) return;
        if (side.model !== of) renderer.release(side);
        Object.assign(side, { model: of, sortedVersion: current, kept, distance });
        renderer.upload(side, rows, count);
      });
    } catch (error) {
      listeners.error(error);
      side.sortedVersion = current; // no second request for this state
    }
    side.busy = false;
    schedule(true);
  }

  return {
    state, listeners, change,
    show(next, nextBase) {
      for (const old of [model, base]) if (old && old !== nextBase) { old.destroyed = true; old.destroy(); }
      [model, base] = [next, nextBase];
      for (const side of [main, second]) renderer.release(side);
      [main, second] = [makeSide(), makeSide()]; // the old ones may wait for a worker that has ended
      change();
    },
    /** Holds so many frames per second by the dial, at full resolution; null ends that. */
    setHold(fps) {
      hold = fps ? createHold(fps) : null;
      if (fps) resolution = 1;
      change();
    },
    get holds() { return hold !== null; },
    get model() { return model; },
    get base() { return base; },
    get frameMs() { return frameMs; },
    view: () => camera.view(...size()),
    counts: () => ({ total: model?.count ?? 0, kept: main.kept, drawn: main.drawn }),
    otherCounts: () => (state.wipe === null ? null : { total: second.model?.count ?? 0, kept: second.kept }),
    /** Resolves once the current state is drawn, and a held frame rate has settled. */
    whenDrawn: () => (isDrawn() || !model ? Promise.resolve() : new Promise((resolve) => { callbacks.push(resolve); schedule(); })),
    /** Ends the lower resolution during motion at once. */
    endMotion() {
      if (performance.now() - lastMotion >= IDLE) return;
      lastMotion = -Infinity;
      change();
    },
    /** Draws again, for reading the canvas in the same task: it is cleared between frames. */
    redraw() {
      renderer.draw(sides().map(({ side }) => side), camera.view(...size()));
    },
  };
}

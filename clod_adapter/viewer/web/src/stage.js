// What is shown: one model at one dial value, or two sides of a wipe. Frames are drawn when something has changed.

const COARSEST = 0.5; // of the canvas's pixels a side, while it moves on a slow device
const SLOW = 50, FAST = 25; // ms a frame: coarser while moving above the one, finer again below the other
const REST = 180; // ms without movement, then a last frame in full

export function createStage(renderer, canvas, camera) {
  const state = { dial: 1, equation: true, wipe: null, other: "base" };
  const listeners = { frame: () => {}, error: () => {} };
  let main = makeSide(), second = makeSide(), model = null, base = null;
  let version = 0, drawn = -1, coarse = 1, moved = -Infinity, rest = 0, frame = 0, took = null, timing = false, warm = false, fresh = false, skipped = false;
  const waiting = [];

  function makeSide() {
    return { model: null, order: null, drawn: 0, have: -1, kept: 0, distance: 1, from: 0, to: 1, busy: false };
  }

  /** What each side is to show now. */
  function sides() {
    const left = { side: main, model, dial: state.dial, equation: state.equation };
    if (state.wipe === null || !model) return [left];
    const againstBase = state.other === "base";
    const right = {
      side: second, model: againstBase ? base ?? model : model, dial: againstBase ? 1 : state.other,
      equation: againstBase ? false : state.equation,
    };
    return [left, right];
  }

  function size() {
    const scale = Math.min(window.devicePixelRatio || 1, 2) * (performance.now() - moved < REST ? coarse : 1);
    return [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(Math.round(side * scale), 1));
  }

  function change({ moving = false } = {}) {
    version++;
    if (moving) {
      moved = performance.now();
      clearTimeout(rest);
      rest = setTimeout(() => coarse < 1 && change(), REST + 20);
    }
    schedule();
  }

  function schedule(sorted = false) {
    fresh ||= sorted;
    frame ||= requestAnimationFrame(() => draw().catch(listeners.error));
  }

  async function draw() {
    frame = 0;
    if (!model || renderer.gl.isContextLost()) return;
    const present = version, view = camera.view(...size()), shown = sides();
    for (const wanted of shown) ask(wanted, view, present);
    if (shown.some(({ side, model: of }) => side.have < 0 || side.model !== of)) return; // not sorted once yet
    skipped = timing && took > SLOW; // one frame at a time, or a slow device shows where the camera was long ago
    if (skipped) return;
    // At rest the sorted frame follows at once, and is enough; while it moves, an old order is better than none.
    const complete = shown.every(({ side }) => side.have === present);
    if (!complete && !fresh && performance.now() - moved > REST) return;
    fresh = false;
    shown.forEach(({ side, dial, equation, model: of }, k) => {
      side.dial = dial;
      side.dialled = equation && of.attenuation !== null;
      side.from = k === 0 ? 0 : state.wipe;
      side.to = shown.length === 1 || k === 1 ? 1 : state.wipe;
    });
    const began = performance.now();
    renderer.draw(shown.map(({ side }) => side), view);
    if (!timing) {
      timing = true;
      renderer.finished(began).then(timed);
    }
    if (complete) {
      drawn = present;
      for (const resolve of waiting.splice(0)) resolve();
    }
    listeners.frame();
  }

  function timed(ms) {
    timing = false;
    if (skipped) schedule();
    if (!warm) { // the first frame compiles, and says nothing about the next
      warm = true;
      return schedule();
    }
    took = ms;
    if (ms > SLOW) coarse = Math.max(coarse * 0.8, COARSEST);
    else if (ms < FAST) coarse = Math.min(coarse * 1.1, 1);
    listeners.frame();
  }

  /** Has the worker sort for the present state, one order at a time. */
  async function ask({ side, model: of, dial, equation }, view, present) {
    if (side.busy || (side.have === present && side.model === of)) return;
    side.busy = true;
    try {
      await of.order({ view, dial, equation }, ({ rows, drawn: count, kept, distance }) => {
        if (of.gone) return;
        if (side.model !== of) renderer.release(side);
        Object.assign(side, { model: of, have: present, kept, distance });
        renderer.upload(side, rows, count);
      });
    } catch (error) {
      listeners.error(error);
      side.have = present; // once is enough
    }
    side.busy = false;
    schedule(true);
  }

  return {
    state, listeners, change,
    show(next, nextBase) {
      for (const old of [model, base]) if (old) { old.gone = true; old.destroy(); }
      [model, base] = [next, nextBase];
      for (const side of [main, second]) renderer.release(side);
      [main, second] = [makeSide(), makeSide()]; // the old ones may wait for a worker that is gone
      change();
    },
    get model() { return model; },
    get base() { return base; },
    get frameMs() { return took; },
    view: () => camera.view(...size()),
    counts: () => ({ total: model?.count ?? 0, kept: main.kept, drawn: main.drawn }),
    otherCounts: () => (state.wipe === null ? null : { total: second.model?.count ?? 0, kept: second.kept }),
    settled: () => (drawn === version || !model ? Promise.resolve() : new Promise((resolve) => { waiting.push(resolve); schedule(); })),
    /** As when nothing moves: at full resolution. */
    still() {
      if (performance.now() - moved >= REST) return;
      moved = -Infinity;
      change();
    },
    /** Once more, to be read at once: the canvas keeps nothing between frames. */
    redraw() {
      renderer.draw(sides().map(({ side }) => side), camera.view(...size()));
    },
  };
}

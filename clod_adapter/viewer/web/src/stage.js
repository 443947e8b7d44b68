// What is shown: a model, or two divided by a wipe. A frame is drawn after a change, and while a held frame rate settles.
import { NEWEST, createHold, median } from "../../../../viewers/frame_rate.js";
import { findPanel, viewOf } from "./camera.js";
import { createModel } from "./model.js";
import { elements, state, ui } from "./page.js";
import { createRenderer } from "./renderer.js";

export let model = null, base = null, hold = null, frameMs = null;
let renderer = null, sides = [], version = 0, drawnVersion = -1, frame = 0, moving = false;
const SLOW = 500; // milliseconds of a frame that alone tells enough
let warm = false; // a frame has been drawn; the first one compiles the shaders
const callbacks = []; // of whenDrawn

/** Shows a model as read from a file, and its base: null for none, undefined for the present one. */
export function show(read, readBase) {
  renderer ??= createRenderer(elements.canvas);
  const next = createModel(renderer.gl, read);
  const nextBase = readBase ? createModel(renderer.gl, readBase) : readBase === null ? null : base;
  for (const old of [model, base]) if (old !== nextBase) old?.destroy();
  [model, base] = [next, nextBase];
  for (const side of sides) renderer.release(side);
  sides = [0, 1].map(() => ({ model: null, order: null, drawn: 0, kept: 0, version: -1, busy: false }));
  change();
}

/** What each side shows, in a range of the width; the right one has no dial. */
function shown() {
  const { dial, equation } = state, wipe = state.wipe ?? 1;
  const left = { side: sides[0], model, dial, attenuated: equation && model.attenuation !== null, from: 0, to: wipe };
  const right = { side: sides[1], model: base ?? model, dial: 1, attenuated: false, from: wipe, to: 1 };
  return state.wipe === null ? [left] : [left, right];
}

export function view() {
  const scale = Math.min(window.devicePixelRatio, 2), { clientWidth, clientHeight } = elements.canvas;
  return viewOf(...[clientWidth, clientHeight].map((side) => Math.max(Math.round(side * scale), 1)));
}

/** Draws a changed state. In motion an earlier order is drawn until the current one is there. */
export function change(inMotion = false) {
  version++;
  moving = inMotion;
  hold?.wake();
  schedule();
}

/** Places the picture anew beside a panel or in a window that has changed. */
export function layOut() {
  findPanel();
  change();
}

const isDrawn = () => drawnVersion === version && (!hold || hold.settled);

function schedule() {
  frame ||= requestAnimationFrame(() => {
    frame = 0;
    try {
      if (model && !renderer.gl.isContextLost()) draw();
    } catch (error) {
      ui.showMessage(error.message);
    }
  });
}

function draw() {
  const current = version, seen = view(), all = shown();
  for (const each of all) requestOrder(each, seen, current);
  const complete = all.every(({ side }) => side.version === current);
  if (all.some(({ side, model: of }) => side.model !== of) || (!complete && !moving)) return;
  const milliseconds = renderer.draw(all, seen);
  if (complete) drawnVersion = current;
  if (warm) took(milliseconds);
  else schedule();
  warm = true;
  if (isDrawn()) for (const resolve of callbacks.splice(0)) resolve();
  ui.updateFrame();
}

/** Takes the time of a frame, for the held frame rate: the next one has another dial value until it has settled. */
function took(milliseconds) {
  frameMs = milliseconds;
  if (!hold || hold.settled) return;
  const { dial } = state;
  state.dial = hold.took(dial, frameMs, model.maxDial);
  if (state.dial !== dial) version++;
  if (!isDrawn()) schedule();
  ui.heldFrame(hold.outOfReach(model.maxDial));
}

/** Requests the order for the current state, one at a time for each side. */
async function requestOrder({ side, model: of, dial, attenuated }, seen, current) {
  if (side.busy || (side.version === current && side.model === of)) return;
  side.busy = true;
  try {
    const { rows, ...about } = await of.order({ view: seen, dial, attenuated });
    if (!sides.includes(side)) return; // another file is there
    if (side.model !== of) renderer.release(side);
    Object.assign(side, about, { model: of });
    renderer.upload(side, rows);
  } catch (error) {
    ui.showMessage(error.message);
  }
  side.version = current;
  side.busy = false;
  schedule();
}

/** The milliseconds of a frame of the present state: the median of a few, or of one that is slow. */
export async function measure() {
  const times = [];
  while (times.length < NEWEST && !(times[0] > SLOW)) {
    change();
    await whenDrawn();
    times.push(frameMs);
  }
  return median(times);
}

/** Holds so many frames per second by the dial; null ends that. */
export function setHold(fps) {
  hold = fps ? createHold(fps) : null;
  change();
}

/** Of the left side, 0, or the right one. */
export const counts = (k = 0) => ({ total: [model, base ?? model][k]?.whole ?? 0, kept: sides[k]?.kept ?? 0 });

/** Resolves once the current state is drawn, and a held frame rate has settled. */
export const whenDrawn = () =>
  isDrawn() || !model ? Promise.resolve() : new Promise((resolve) => { callbacks.push(resolve); schedule(); });

/** Draws, for reading the canvas in the same task: it is cleared between frames. */
export const redraw = () => renderer.draw(shown(), view());

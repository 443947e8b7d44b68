// Assembles the page, and defines `window.clod` for tests and scripts.
import { createCamera } from "./camera.js";
import { createControls } from "./controls.js";
import { createFiles, readConfig } from "./files.js";
import { canRecord } from "./media.js";
import { createModel } from "./model.js";
import { createMotion } from "./motion.js";
import { createRenderer } from "./renderer.js";
import { createStage } from "./stage.js";
import { createUi, elementsOf } from "./ui.js";
import { createViews } from "./views.js";

const OPENING = 30, HOPELESS = Math.log(2); // frames per second that the dial is moved for; excess at its largest value, above which it is not moved

const elements = elementsOf(document), config = readConfig();
const viewer = { cameraNumber: 0, cameras: config.cameras, up: "", recording: null, file: 0, opening: null, notes: "" }; // opening: the dial value that a file was opened at, null once that is settled; notes: on a dropped file
viewer.files = config.model ? [config.model, ...config.others] : [];

async function start() {
  const renderer = createRenderer(elements.canvas), camera = createCamera(), stage = createStage(renderer, elements.canvas, camera);
  const moved = () => {
    stage.change({ moving: true });
    viewer.ui.showNote(""); // it was of another view
  };
  Object.assign(actions, files, createViews(elements, viewer, { update, clampDial, showFile: files.showFile }));
  const controls = createControls(elements.canvas, camera, () => {
    viewer.motion.stop();
    viewer.ui.selectCamera(null);
    moved();
  });
  Object.assign(viewer, { renderer, camera, stage, controls, motion: createMotion(camera, moved, () => viewer.ui.update()) });
  viewer.ui = createUi(elements, viewer, actions, canRecord());
  stage.listeners.frame = viewer.ui.updateFrame;
  stage.listeners.held = (outOfReach, excess) => {
    viewer.ui.update();
    const slow = outOfReach && `s = ${stage.model.max_sv}, the largest trained value, is too slow for this frame rate`;
    if (viewer.opening === null) viewer.ui.showNote(slow || "");
    else if (excess > HOPELESS) endOpening(viewer.opening, `Dial not moved: under ${OPENING / 2} fps at any value`);
  };
  stage.listeners.error = (error) => viewer.ui.showMessage(error.message);
  new ResizeObserver(actions.layOut).observe(elements.canvas);
  elements.canvas.addEventListener("webglcontextlost", () => viewer.ui.showMessage("The graphics device was lost; reload the page."));
  viewer.ui.showName(config.title || "clod-adapter", 0, viewer.files.map(({ name }) => name));
  viewer.ui.update();
  if (!config.model) return viewer.ui.showProgress("Drop a splat here, or open one");
  await files.open(() => {
    window.addEventListener("hashchange", () => actions.applyLink(location.hash));
    return actions.applyLink(location.hash);
  });
  elements.poster?.remove();
  await settle();
}

/** Moves the dial from where a file was opened until the device holds a frame rate. A touch of the dial ends it. */
async function settle() {
  const { stage } = viewer, { model } = stage;
  if (!model?.attenuation || viewer.opening === null) return;
  stage.setHold(OPENING);
  await stage.whenDrawn();
  const { dial } = stage.state;
  if (viewer.opening !== null && stage.model === model) endOpening(dial, dial !== viewer.opening && `Moved to s = ${dial.toFixed(2)} for ${OPENING} fps on this device`);
}

/** Ends the hold at a dial value, and shows the notes on the file and what became of the dial. */
function endOpening(dial, note) {
  actions.setDial(dial);
  viewer.ui.showNote([viewer.notes, note].filter(Boolean).join("; "));
}

const upload = ({ gaussians, metadata }) => createModel(viewer.renderer.gl, gaussians, metadata);

/** Shows another scene, and starts anew. `dial`: null for s = 1 with photographs, else everything, then what the
 *  device holds. */
function show(model, base, cameras, dial) {
  const { stage, ui } = viewer;
  const [uploaded, uploadedBase] = [upload(model), base && upload(base)];
  Object.assign(stage.state, { dial: 1, equation: true, wipe: null });
  viewer.up = viewer.notes = "";
  stage.setHold(null);
  stage.show(uploaded, uploadedBase);
  viewer.cameras = cameras;
  ui.listCameras(cameras);
  ui.update(); // rows of the panel, before the picture is placed beside it
  actions.layOut();
  actions.reset();
  stage.state.dial = clampDial(dial ?? (cameras.some(({ placed }) => !placed) ? 1 : 0)); // s = 1 is fitted to photographs
  viewer.opening = dial === null ? stage.state.dial : null;
  update();
}

/** Shows another model of the same scene and, if given, its base; the rest stays. */
const replace = (model, base) => viewer.stage.show(upload(model), base ? upload(base) : viewer.stage.base);

const clampDial = (dial) => Math.min(Math.max(dial, 0), viewer.stage.model.max_sv);

/** Shows a changed state, and removes the note, which was of the former one. */
function update() {
  viewer.ui.showNote("");
  viewer.stage.change();
  viewer.ui.update();
  viewer.ui.updateFrame();
}

/** What the controls call; `start` adds those of files and views. */
const actions = {
  isFlying: () => viewer.controls.flying,
  setDial(dial) {
    if (!(dial >= 0)) throw new Error(`the dial value is ${dial}; it must be at least 0`);
    viewer.stage.state.dial = dial;
    actions.setHold(null);
  },
  setEquation(on) {
    viewer.stage.state.equation = Boolean(on);
    if (on) update();
    else actions.setHold(null); // no dial value changes a frame's time then
  },
  /** Holds a frame rate by the dial, frames per second; null ends that. */
  setHold(fps) {
    const { stage } = viewer;
    viewer.opening = null;
    if (fps) stage.state.equation = true;
    stage.setHold(fps);
    update();
  },
  /** Compares with the base, or with the model without its dial, right of a share of the width; null ends that. */
  setWipe(position) {
    const { state, base } = viewer.stage;
    if (position !== null && !base) state.equation = true; // else both sides would be the same
    state.wipe = position;
    update();
  },
  async setTarget(text) {
    const target = Number(text.replaceAll(/[\s,_.'](?=\d{3}(?!\d))/g, ""));
    if (!text.trim()) return viewer.ui.showNote("");
    if (!(Number.isInteger(target) && target > 0)) return viewer.ui.showNote("Enter a number of Gaussians, such as 20000");
    const { stage } = viewer;
    const { dial, kept } = await stage.model.dialFor(stage.view(), target);
    stage.state.equation = true;
    actions.setDial(dial);
    const max = stage.model.max_sv, count = kept.toLocaleString("en");
    if (kept > target) viewer.ui.showNote(`s = ${max}, the largest trained value, keeps ${count} in this view`);
    else if (dial === 1) viewer.ui.showNote(`s = 1 already keeps no more than ${count} in this view`);
    else viewer.ui.showNote(`s = ${dial.toFixed(3)} keeps ${count} in this view`);
  },
  toggleFlying() {
    viewer.controls.flying = !viewer.controls.flying;
    viewer.ui.update();
  },
  fullScreen: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.()),
};

const files = createFiles(elements, viewer, config, { show, replace, update, clampDial, settle });
const ready = start().catch((error) => {
  elements.busy.hidden = true;
  elements.panel.hidden = !viewer.ui; // without it, no control works
  elements.message.hidden = false;
  elements.message.firstElementChild.textContent = error.message;
  throw error;
});
ready.catch(() => {}); // shown on the page; awaiting `ready` throws it too

window.clod = {
  ready, load: (buffer, name) => files.load(new Blob([buffer]), name),
  setDial: actions.setDial, setEquation: actions.setEquation, setHold: actions.setHold, setWipe: actions.setWipe,
  setCamera(camera) {
    viewer.camera.set(camera);
    viewer.stage.change();
  },
  whenDrawn: () => viewer.stage.whenDrawn(),
  counts: () => viewer.stage.counts(),
  async capture() {
    viewer.stage.endMotion();
    await viewer.stage.whenDrawn();
    viewer.stage.redraw();
    return elements.canvas.toDataURL("image/png");
  },
};

// Assembles the page, and defines `window.clod` for tests and scripts.
import { createCamera } from "./camera.js";
import { createControls } from "./controls.js";
import { readFile } from "./formats/index.js";
import { readLink, writeLink } from "./link.js";
import { createModel } from "./model.js";
import { fetchModel, readConfig } from "./payload.js";
import { createRenderer } from "./renderer.js";
import { createStage } from "./stage.js";
import { createUi, elementsOf } from "./ui.js";
import { createWipe } from "./wipe.js";

const elements = elementsOf(document), config = readConfig();
let viewer;

async function start() {
  const renderer = createRenderer(elements.canvas), camera = createCamera();
  const stage = createStage(renderer, elements.canvas, camera);
  const controls = createControls(elements.canvas, camera, () => {
    stage.change({ moving: true });
    viewer.ui.selectCamera(null);
  });
  const wipe = createWipe(elements, stage);
  viewer = { renderer, camera, stage, controls, wipe, cameraNumber: 0, cameras: config.cameras };
  viewer.ui = createUi(elements, stage, actions);
  stage.listeners.frame = viewer.ui.updateFrame;
  stage.listeners.held = (outOfReach) => {
    viewer.ui.update();
    viewer.ui.showNote(outOfReach ? `s = ${stage.model.max_sv}, the largest trained value, is too slow for this frame rate` : "");
  };
  stage.listeners.error = (error) => viewer.ui.showMessage(error.message);
  new ResizeObserver(() => stage.change()).observe(elements.canvas);
  elements.canvas.addEventListener("webglcontextlost", () => viewer.ui.showMessage("The graphics device was lost; reload the page."));
  listenForFiles();
  document.title = elements.title.textContent = config.title || "clod-adapter";
  viewer.ui.update();
  if (!config.model) return viewer.ui.showProgress("Drop a splat here, or open one");
  const [model, base] = await Promise.all([config.model, config.base].map((entry) => entry && fetchNamed(entry)));
  if (loadCount) return; // another file was dropped meanwhile
  show(model, base, config.cameras, config.virtual_scale);
  applyLink(readLink(location.hash));
  window.addEventListener("hashchange", () => applyLink(readLink(location.hash)));
  await stage.whenDrawn();
}

const fetchNamed = (entry) => fetchModel(entry, (fraction) => viewer.ui.showProgress(`Loading ${entry.name}: ${Math.floor(100 * fraction)} %`)).catch((error) => { throw new Error(`${entry.name}: ${error.message}`); });

function show(model, base, cameras, dial) {
  const { renderer, stage, camera, ui } = viewer;
  const upload = ({ gaussians, metadata }) => createModel(renderer.gl, gaussians, metadata);
  const [uploaded, uploadedBase] = [upload(model), base && upload(base)];
  Object.assign(stage.state, { dial: 1, equation: true, wipe: null, other: "base" });
  stage.setHold(null);
  stage.show(uploaded, uploadedBase);
  viewer.cameras = cameras;
  ui.listCameras(cameras);
  actions.reset();
  stage.state.dial = clampDial(dial);
  ui.showProgress(null);
  ui.showNote("");
  update();
}

const clampDial = (dial) => Math.min(Math.max(dial, 1), viewer.stage.model.max_sv);

function update() {
  viewer.stage.change();
  viewer.ui.update();
  viewer.ui.updateFrame();
  viewer.wipe.update();
}

function applyLink({ eye, rotation, fov, distance, dial, equation, wipe, other }) {
  const { camera, stage } = viewer;
  if (eye && rotation) {
    Object.assign(camera, { eye, rotation, intrinsics: null });
    viewer.ui.selectCamera(null);
  }
  camera.fov = fov ?? camera.fov;
  camera.distance = distance ?? camera.distance;
  stage.setHold(null);
  const { attenuation } = stage.model, comparable = wipe !== null && (attenuation || stage.base);
  Object.assign(stage.state, {
    dial: clampDial(dial ?? stage.state.dial), equation, wipe: comparable ? Math.min(Math.max(wipe, 0), 1) : null,
    other: other === "base" || !attenuation ? "base" : clampDial(other),
  });
  update();
}

const actions = {
  isFlying: () => viewer.controls.flying,
  setDial(dial) {
    if (!(dial >= 1)) throw new Error(`the dial value is ${dial}; it must be at least 1`);
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
    const { stage, ui } = viewer;
    if (fps) stage.state.equation = true;
    stage.setHold(fps);
    ui.showNote("");
    update();
  },
  setWipe(position, other = viewer.stage.state.other) {
    Object.assign(viewer.stage.state, { wipe: position, other });
    update();
  },
  compare(mode) {
    const { state } = viewer.stage, position = state.wipe ?? 0.5;
    if (mode === "off") actions.setWipe(null);
    else actions.setWipe(position, mode === "base" ? "base" : state.other === "base" ? viewer.stage.model.max_sv : state.other);
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
  reset() {
    viewer.camera.fit(viewer.stage.model.extent, viewer.cameras);
    viewer.camera.intrinsics = null; // fills the window
    viewer.cameraNumber = 0;
    viewer.ui.selectCamera(0);
    update();
  },
  nextCamera(step) {
    const { length } = viewer.cameras;
    if (length) actions.goTo((viewer.cameraNumber + step + length) % length);
  },
  goTo(number) {
    viewer.camera.set(viewer.cameras[number]);
    viewer.camera.intrinsics = null;
    viewer.cameraNumber = number;
    viewer.ui.selectCamera(number);
    update();
  },
  async copyLink() {
    const link = writeLink(viewer.camera, viewer.stage.state);
    history.replaceState(null, "", link);
    try {
      await navigator.clipboard.writeText(link);
      viewer.ui.showNote(viewer.dropped ? "Link copied; it contains the view, not the file" : "Link copied");
    } catch {
      viewer.ui.showNote("The link is in the address bar"); // file:// pages may not write to the clipboard
    }
  },
  fullScreen: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.()),
  openFile(file) {
    const refuse = () => { throw new Error("the browser cannot read it: it is a folder or too large"); };
    return load(file.arrayBuffer().catch(refuse), file.name).catch(() => {});
  },
};

let loadCount = 0;

/** Shows another file, from a buffer or a promise of one; of concurrent calls, the last. If reading fails, the page shows
 *  an error and keeps the previous file. */
async function load(buffer, name) {
  const { ui, stage } = viewer, number = ++loadCount;
  ui.showProgress(`Reading ${name}`);
  try {
    const read = await readFile(await buffer, name);
    if (number !== loadCount) return;
    show(read, null, [], 1);
    viewer.dropped = true;
    ui.showNote(read.metadata.notes.join("; "));
    document.title = elements.title.textContent = name;
    ui.showMessage(null);
    await stage.whenDrawn();
  } catch (error) {
    const message = `${name}: ${error.message}`;
    if (number === loadCount) ui.showMessage(message);
    throw new Error(message);
  } finally {
    if (number === loadCount) ui.showProgress(null);
  }
}

function listenForFiles() {
  const showTarget = (on) => { elements.drop.hidden = !on; };
  window.addEventListener("dragover", (event) => { event.preventDefault(); showTarget(true); });
  window.addEventListener("dragleave", (event) => { if (!event.relatedTarget) showTarget(false); });
  window.addEventListener("drop", (event) => {
    event.preventDefault();
    showTarget(false);
    const [file] = event.dataTransfer.files;
    if (file) actions.openFile(file);
  });
}

const ready = start().catch((error) => {
  elements.busy.hidden = true;
  elements.panel.hidden = !viewer?.ui; // without it, no control works
  elements.message.hidden = false;
  elements.message.firstElementChild.textContent = error.message;
  throw error;
});
ready.catch(() => {}); // shown on the page; awaiting `ready` throws it too

window.clod = {
  ready, load,
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

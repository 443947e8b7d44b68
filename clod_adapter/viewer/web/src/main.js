// Assembles the page, and defines `window.clod` for tests and scripts.
import { createCamera } from "./camera.js";
import { createControls } from "./controls.js";
import { readFile } from "./formats/index.js";
import { readLink, writeLink } from "./link.js";
import { canRecord, download, record } from "./media.js";
import { createMenu } from "./menu.js";
import { createModel } from "./model.js";
import { createMotion } from "./motion.js";
import { fetchModel, readConfig } from "./payload.js";
import { createRenderer } from "./renderer.js";
import { createStage } from "./stage.js";
import { createUi, elementsOf } from "./ui.js";
import { upOfCameras } from "./up.js";
import { createWipe } from "./wipe.js";
import { startXr, xrModes } from "./xr.js";

const elements = elementsOf(document), config = readConfig();
let viewer;

async function start() {
  const renderer = createRenderer(elements.canvas), camera = createCamera();
  const stage = createStage(renderer, elements.canvas, camera);
  const moved = () => {
    stage.change({ moving: true });
    viewer.ui.showNote(""); // it was of another view
  };
  const controls = createControls(elements.canvas, camera, () => {
    viewer.motion.stop();
    viewer.ui.selectCamera(null);
    moved();
  }, actions.focus);
  const motion = createMotion(camera, moved, () => viewer.menu.update());
  const wipe = createWipe(elements, stage);
  viewer = { renderer, camera, stage, controls, motion, wipe, cameraNumber: 0, cameras: config.cameras, up: "", recording: null };
  Object.assign(viewer, { files: config.model ? [config.model, ...config.others] : [], file: 0 });
  viewer.ui = createUi(elements, stage, actions);
  viewer.menu = createMenu(elements, viewer, actions, canRecord());
  xrModes().then(viewer.menu.showModes);
  stage.listeners.frame = viewer.ui.updateFrame;
  stage.listeners.held = (outOfReach) => {
    viewer.ui.update();
    viewer.ui.showNote(outOfReach ? `s = ${stage.model.max_sv}, the largest trained value, is too slow for this frame rate` : "");
  };
  stage.listeners.error = (error) => viewer.ui.showMessage(error.message);
  new ResizeObserver(actions.layOut).observe(elements.canvas);
  elements.canvas.addEventListener("webglcontextlost", () => viewer.ui.showMessage("The graphics device was lost; reload the page."));
  listenForFiles();
  viewer.ui.showName(config.title || "clod-adapter", 0, viewer.files.map(({ name }) => name));
  viewer.ui.update();
  if (!config.model) return viewer.ui.showProgress("Drop a splat here, or open one");
  const [model, base] = await Promise.all([config.model, config.base].map((entry) => entry && fetchNamed(entry)));
  if (loadCount) return; // another file was dropped meanwhile
  show(model, base, config.cameras, config.virtual_scale);
  await applyLink(readLink(location.hash));
  window.addEventListener("hashchange", () => applyLink(readLink(location.hash)));
  await stage.whenDrawn();
}

const fetchNamed = (entry) => fetchModel(entry, (fraction) => viewer.ui.showProgress(`Loading ${entry.name}: ${Math.floor(100 * fraction)} %`)).catch((error) => { throw new Error(`${entry.name}: ${error.message}`); });

const upload = ({ gaussians, metadata }) => createModel(viewer.renderer.gl, gaussians, metadata);

function show(model, base, cameras, dial) {
  const { stage, ui } = viewer;
  const [uploaded, uploadedBase] = [upload(model), base && upload(base)];
  Object.assign(stage.state, { dial: 1, equation: true, marks: false, wipe: null, other: "base" });
  viewer.up = "";
  stage.setHold(null);
  stage.show(uploaded, uploadedBase);
  viewer.cameras = cameras;
  ui.listCameras(cameras);
  ui.update(); // rows of the panel, before the picture is placed beside it
  actions.layOut();
  actions.reset();
  stage.state.dial = clampDial(dial);
  ui.showProgress(null);
  update();
}

const clampDial = (dial) => Math.min(Math.max(dial, 1), viewer.stage.model.max_sv);

/** Shows a changed state, and removes the note, which was of the former one. */
function update() {
  viewer.ui.showNote("");
  viewer.stage.change();
  viewer.ui.update();
  viewer.ui.updateFrame();
  viewer.menu.update();
  viewer.wipe.update();
}

async function applyLink({ file, eye, rotation, fov, aspect, up, distance, dial, equation, wipe, other }) {
  const { camera, stage } = viewer;
  if (viewer.file !== null && file !== viewer.file) await actions.showFile(file);
  viewer.motion.stop();
  if (up) [viewer.up, camera.up] = [String(up), up];
  if (eye && rotation) {
    Object.assign(camera, { eye, rotation, intrinsics: null, aspect });
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

/** The last other dial value if it differs from the present one, else the end of the dial that is farther from it. */
function otherDial({ dial, other }) {
  const max = viewer.stage.model.max_sv;
  if (other !== "base" && Math.abs(Math.log(other / dial)) > 0.05 * Math.log(max)) return other;
  return dial * dial > max ? 1 : max;
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
    const { stage } = viewer;
    if (fps) Object.assign(stage.state, { equation: true, marks: false });
    stage.setHold(fps);
    update();
  },
  setWipe(position, other = viewer.stage.state.other) {
    Object.assign(viewer.stage.state, { wipe: position, other });
    update();
  },
  compare(mode) {
    const { state } = viewer.stage, position = state.wipe ?? 0.5;
    if (mode === "off") return actions.setWipe(null);
    if (mode === "dial" || !viewer.stage.base) state.equation = true; // else both sides would be the same
    actions.setWipe(position, mode === "base" ? "base" : otherDial(state));
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
  /** Shows another of the files, from the same view and at the same dial value. */
  async showFile(number) {
    const entry = viewer.files[number], { stage, ui } = viewer, fromDropped = viewer.file === null;
    if (!entry || !stage.model) return;
    const count = ++loadCount;
    try {
      const [read, base] = await Promise.all([entry, fromDropped && config.base].map((each) => each && fetchNamed(each)));
      if (count !== loadCount) return;
      if (fromDropped) show(read, base, config.cameras, config.virtual_scale);
      else stage.show(upload(read), stage.base);
      viewer.file = number;
      ui.showName(entry.name, number);
      if (stage.model.attenuation) stage.state.dial = clampDial(stage.state.dial);
      update();
      await stage.whenDrawn();
    } catch (error) {
      ui.showMessage(error.message);
    } finally {
      if (count === loadCount) ui.showProgress(null);
    }
  },
  /** Shows the Gaussians that the dial removes, in orange. */
  setMarks(on) {
    const { stage } = viewer;
    stage.state.marks = Boolean(on);
    if (!on) return update();
    stage.state.equation = true;
    actions.setHold(null); // it would measure the removed ones too
  },
  toggleFlying() {
    viewer.controls.flying = !viewer.controls.flying;
    viewer.ui.update();
  },
  reset() {
    viewer.motion.stop();
    viewer.camera.fit(viewer.stage.model.extent, viewer.cameras, axisOf(viewer.up));
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
    viewer.motion.stop();
    viewer.camera.set(viewer.cameras[number]);
    viewer.camera.intrinsics = null;
    viewer.cameraNumber = number;
    viewer.ui.selectCamera(number);
    update();
  },
  /** Turns to the point at a position of the canvas, in shares of its size, and orbits about it from now on. */
  focus(x, y) {
    const point = viewer.stage.pick(x, y);
    if (!point) return;
    viewer.ui.selectCamera(null);
    viewer.motion.glide(viewer.camera.lookingAt(point));
  },
  /** `value`: "x,y,z" of an axis; "" for that of the cameras or the scene. */
  setUp(value) {
    viewer.motion.stop();
    viewer.up = value;
    viewer.camera.setUp(axisOf(value));
    viewer.ui.selectCamera(null);
    update();
  },
  /** Plays the path through the photographs or, without any, a turn about the pivot; stops what plays. */
  play() {
    if (viewer.motion.running) viewer.motion.stop();
    else playOnce(actions.play); // again and again
  },
  turntable() {
    if (viewer.motion.running) return viewer.motion.stop();
    viewer.ui.selectCamera(null);
    viewer.motion.turntable(Infinity);
    viewer.menu.update();
  },
  async savePicture() {
    const { stage, motion } = viewer;
    if (!motion.running) await stage.whenDrawn();
    stage.redraw();
    elements.canvas.toBlob((blob) => download(blob, fileName("png")));
  },
  /** Records the path or the turn to its end, or what the camera does until the next call. */
  async record() {
    const { stage, motion, recording } = viewer;
    if (recording) {
      viewer.recording = null;
      stage.state.steady = false;
      motion.stop();
      const { blob, suffix } = await recording.stop();
      download(blob, fileName(suffix));
      return update();
    }
    stage.state.steady = true;
    viewer.recording = record(elements.canvas);
    playOnce(() => viewer.recording && actions.record());
    update();
  },
  async enter(mode) {
    try {
      viewer.motion.stop();
      await startXr(mode, { ...viewer, turnDial: (factor) => { viewer.stage.state.dial = clampDial(viewer.stage.state.dial * factor); } }, update);
    } catch (error) {
      viewer.ui.showMessage(`the headset does not start (${error.message})`);
    }
  },
  /** Tells the camera where the panel is. */
  layOut() {
    const box = elements.panel.getBoundingClientRect(), { innerWidth: width, innerHeight: height } = window;
    viewer.camera.panel = box.width ? [box.right / width, Math.min(1 - box.top / height, 0.5)] : [0, 0];
    viewer.stage.change();
  },
  async copyLink() {
    const link = writeLink(viewer.camera, viewer.stage.state, viewer.up, viewer.file);
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

const axisOf = (value) => (value ? value.split(",").map(Number) : upOfCameras(viewer.cameras) ?? viewer.stage.model.extent.up);

const fileName = (suffix) => `${viewer.stage.model.name.replace(/\.[^.]*$/, "")}_s${viewer.stage.state.dial.toFixed(2)}.${suffix}`;

function playOnce(ended) {
  const { cameras, motion, camera, ui, menu } = viewer;
  const select = (number) => {
    viewer.cameraNumber = number;
    ui.selectCamera(number);
  };
  if (cameras.length < 2) motion.turntable(1, ended);
  else motion.path(posesOf(cameras, camera.distance), select, ended);
  menu.update();
}

function posesOf(cameras, distance) {
  const each = createCamera();
  return cameras.map((entry) => {
    each.set(entry);
    return { ...each.pose, distance };
  });
}

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
    viewer.file = null;
    ui.showName(name, null);
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

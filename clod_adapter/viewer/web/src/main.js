// Puts the page together, and hands `window.clod` to tests and scripts.
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
    viewer.ui.at(null);
  });
  const wipe = createWipe(elements, stage);
  viewer = { renderer, camera, stage, controls, wipe, cameraNumber: 0, cameras: config.cameras };
  viewer.ui = createUi(elements, stage, actions);
  stage.listeners.frame = viewer.ui.frame;
  stage.listeners.error = (error) => viewer.ui.say(error.message);
  new ResizeObserver(() => stage.change()).observe(elements.canvas);
  elements.canvas.addEventListener("webglcontextlost", () => viewer.ui.say("The graphics device went away; reload the page."));
  listenForFiles();
  document.title = elements.title.textContent = config.title || "clod-adapter";
  viewer.ui.show();
  if (!config.model) return viewer.ui.busy("Drop a splat here, or open one");
  const [model, base] = await Promise.all([config.model, config.base].map((entry) => entry && fetchNamed(entry)));
  if (loads) return; // another file was dropped meanwhile
  show(model, base, config.cameras, config.virtual_scale);
  applyLink(readLink(location.hash));
  window.addEventListener("hashchange", () => applyLink(readLink(location.hash)));
  await stage.settled();
}

const fetchNamed = (entry) => fetchModel(entry, (part) => viewer.ui.busy(`Loading ${entry.name}: ${Math.floor(100 * part)} %`)).catch((error) => { throw new Error(`${entry.name}: ${error.message}`); });

function show(model, base, cameras, dial) {
  const { renderer, stage, camera, ui } = viewer;
  const make = ({ gaussians, about }) => createModel(renderer.gl, gaussians, about);
  const [made, madeBase] = [make(model), base && make(base)];
  Object.assign(stage.state, { dial: 1, equation: true, wipe: null, other: "base" });
  stage.show(made, madeBase);
  viewer.cameras = cameras;
  ui.list(cameras);
  actions.reset();
  stage.state.dial = clampDial(dial);
  ui.busy(null);
  ui.note("");
  changed();
}

const clampDial = (dial) => Math.min(Math.max(dial, 1), viewer.stage.model.max_sv);

function changed() {
  viewer.stage.change();
  viewer.ui.show();
  viewer.ui.frame();
  viewer.wipe.show();
}

function applyLink({ eye, rotation, field, reach, dial, equation, wipe, other }) {
  const { camera, stage } = viewer;
  if (eye && rotation) {
    Object.assign(camera, { eye, rotation, exact: null });
    viewer.ui.at(null);
  }
  camera.field = field ?? camera.field;
  camera.reach = reach ?? camera.reach;
  const { attenuation } = stage.model, comparable = wipe !== null && (attenuation || stage.base);
  Object.assign(stage.state, {
    dial: clampDial(dial ?? stage.state.dial), equation, wipe: comparable ? Math.min(Math.max(wipe, 0), 1) : null,
    other: other === "base" || !attenuation ? "base" : clampDial(other),
  });
  changed();
}

const actions = {
  flying: () => viewer.controls.flying,
  setDial(dial) {
    if (!(dial >= 1)) throw new Error(`the dial is ${dial}, it must be at least 1`);
    viewer.stage.state.dial = dial;
    viewer.ui.note("");
    changed();
  },
  setEquation(on) {
    viewer.stage.state.equation = Boolean(on);
    changed();
  },
  setWipe(position, other = viewer.stage.state.other) {
    Object.assign(viewer.stage.state, { wipe: position, other });
    changed();
  },
  compare(kind) {
    const { state } = viewer.stage, position = state.wipe ?? 0.5;
    if (kind === "off") actions.setWipe(null);
    else actions.setWipe(position, kind === "base" ? "base" : state.other === "base" ? viewer.stage.model.max_sv : state.other);
  },
  async setTarget(text) {
    const wanted = Number(text.replaceAll(/[\s,_.'](?=\d{3}(?!\d))/g, ""));
    if (!text.trim()) return viewer.ui.note("");
    if (!(Number.isInteger(wanted) && wanted > 0)) return viewer.ui.note("A number of Gaussians, such as 20000");
    const { stage } = viewer;
    const { dial, kept } = await stage.model.dialFor(stage.view(), wanted);
    stage.state.equation = true;
    actions.setDial(dial);
    const most = stage.model.max_sv;
    if (kept > wanted) viewer.ui.note(`At s = ${most}, the largest trained, ${kept.toLocaleString("en")} are kept here`);
    else if (dial === 1) viewer.ui.note(`s = 1 keeps ${kept.toLocaleString("en")} already`);
    else viewer.ui.note(`s = ${dial.toFixed(3)} keeps ${kept.toLocaleString("en")} in this view`);
  },
  toggleFlying() {
    viewer.controls.flying = !viewer.controls.flying;
    viewer.ui.show();
  },
  reset() {
    viewer.camera.fit(viewer.stage.model.extent, viewer.cameras);
    viewer.camera.exact = null;
    viewer.cameraNumber = 0;
    viewer.ui.at(0);
    changed();
  },
  nextCamera(by) {
    const { length } = viewer.cameras;
    if (length) actions.goTo((viewer.cameraNumber + by + length) % length);
  },
  goTo(number) {
    viewer.camera.set(viewer.cameras[number]);
    viewer.camera.exact = null;
    viewer.cameraNumber = number;
    viewer.ui.at(number);
    changed();
  },
  async copyLink() {
    const link = writeLink(viewer.camera, viewer.stage.state);
    history.replaceState(null, "", link);
    try {
      await navigator.clipboard.writeText(link);
      viewer.ui.note(viewer.dropped ? "Link copied: to this view, not to the file" : "Link copied");
    } catch {
      viewer.ui.note("The link is in the address bar"); // file:// pages may not write to the clipboard
    }
  },
  fullScreen: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.()),
  openFile(file) {
    const unread = () => { throw new Error("the browser cannot read it: it is a folder, or too large"); };
    return load(file.arrayBuffer().catch(unread), file.name).catch(() => {});
  },
};

let loads = 0;

/** Shows another file, out of a buffer or a promise of one; of several the last. Where it cannot be read what was shown
 *  stays, and the message says why. */
async function load(buffer, name) {
  const { ui, stage } = viewer, turn = ++loads;
  ui.busy(`Reading ${name}`);
  try {
    const read = await readFile(await buffer, name);
    if (turn !== loads) return;
    show(read, null, [], 1);
    viewer.dropped = true;
    ui.note(read.about.notes.join("; "));
    document.title = elements.title.textContent = name;
    ui.say(null);
    await stage.settled();
  } catch (error) {
    const message = `${name}: ${error.message}`;
    if (turn === loads) ui.say(message);
    throw new Error(message);
  } finally {
    if (turn === loads) ui.busy(null);
  }
}

function listenForFiles() {
  const over = (on) => { elements.drop.hidden = !on; };
  window.addEventListener("dragover", (event) => { event.preventDefault(); over(true); });
  window.addEventListener("dragleave", (event) => { if (!event.relatedTarget) over(false); });
  window.addEventListener("drop", (event) => {
    event.preventDefault();
    over(false);
    const [file] = event.dataTransfer.files;
    if (file) actions.openFile(file);
  });
}

const ready = start().catch((error) => {
  elements.busy.hidden = true;
  elements.panel.hidden = !viewer?.ui; // it works nothing without
  elements.message.hidden = false;
  elements.message.firstElementChild.textContent = error.message;
  throw error;
});
ready.catch(() => {}); // shown on the page; who awaits `ready` sees it too

window.clod = {
  ready, load,
  setDial: actions.setDial, setEquation: actions.setEquation, setWipe: actions.setWipe,
  setCamera(camera) {
    viewer.camera.set(camera);
    viewer.stage.change();
  },
  settled: () => viewer.stage.settled(),
  counts: () => viewer.stage.counts(),
  async capture() {
    viewer.stage.still();
    await viewer.stage.settled();
    viewer.stage.redraw();
    return elements.canvas.toDataURL("image/png");
  },
};

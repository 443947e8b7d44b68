// The files that the page shows: those of its server or its own, and dropped ones.
import { EXPONENT, budgetOf } from "../../../../viewers/frame_rate.js";
import { readGaussians } from "../../../../viewers/read.js";
import { config, elements, state, ui, viewer } from "./page.js";
import * as stage from "./stage.js";
import { add } from "./vector.js";
import { applyLink, reset } from "./views.js";

const OPENING = 30; // frames per second that are held when a file opens

const fetchModel = async ({ name, href, element }) => readFile(href ? await download(href) : included(element), name);

const blobs = {}; // by id

/** The bytes that the elements with this id have in base64; removes these elements, for their memory. */
function included(id) {
  return blobs[id] ??= new Blob([...document.querySelectorAll(`[id="${id}"]`)].map((element) => {
    const characters = atob(element.textContent.trim()), bytes = new Uint8Array(characters.length);
    element.remove();
    for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
    return bytes;
  }));
}

async function download(href, request) {
  const response = await fetch(href, request).catch(() => { throw new Error("the server does not answer; start clod-adapt view again"); });
  if (response.ok) return response.blob();
  const isReason = response.headers.get("Content-Type").startsWith("text/plain"); // server.py's, of a file
  throw new Error(isReason ? await response.text() : `the server answered ${response.status} ${response.statusText}`);
}

/** What a file, a Blob, holds (viewers/read.js), with its name; `convert(blob, name)` reads other formats. */
async function readFile(blob, name, convert = null) {
  const failed = (message) => { throw new Error(`${name}: ${message}`); };
  const bytes = await blob.arrayBuffer().catch(() => failed("the browser cannot read it: it is a folder or too large"));
  const read = await readGaussians(new Uint8Array(bytes)).catch(({ message }) => {
    if (/(again|paper)$/.test(message)) return failed(message);
    return convert?.(blob, name) ?? failed(`${message}; clod-adapt view ${name} opens every format`);
  });
  return { ...read, name };
}

/** What the server of `clod-adapt view` reads of a file; a page without a server has no converter. */
async function convert(blob, name) {
  const { href, limit } = config.converter;
  if (blob.size > limit) throw new Error(`${name}: has more than ${limit / 2 ** 30} GiB; clod-adapt view ${name} opens it`);
  const response = await download(`${href}?${new URLSearchParams({ name })}`, { method: "POST", body: blob });
  return readFile(response, name);
}

let home = null; // extent of the first file

/** The cameras of the page, if it shows the scene of its first file. */
function ownCameras() {
  home ??= stage.model.extent;
  return isAlike(home, stage.model.extent) ? config.cameras : [];
}

/** Whether two extents may be of one scene, as those of its levels. */
const isAlike = (one, other) => Math.abs(Math.log(one.radius / other.radius)) < Math.log(2)
  && Math.hypot(...add(one.centre, other.centre, -1)) < Math.max(one.radius, other.radius) / 2;

/** Shows a scene from its own start. */
function look(cameras) {
  Object.assign(viewer, { cameras, up: "" });
  ui.listCameras();
  reset();
}

/** Shows another scene: at the page's dial value, else s = 1 for photographs or everything, and what the device holds.
 *  `cameras()`: of the scene that is there. */
function show(read, base, cameras) {
  const dial = config.virtual_scale;
  Object.assign(state, { dial: 1, equation: true, wipe: null });
  stage.setHold(null);
  stage.show(read, base);
  look(cameras());
  state.dial = ui.clampDial(dial ?? (viewer.photographs.length ? 1 : 0));
  ui.changed();
  viewer.opening = dial === null && read.settings ? state.dial : null;
}

let asked = 0; // files, the last of which is shown

/** Opens a file by `read()` and `present(what is read)`, unless another one is asked for before it is there. */
async function open(name, read, present) {
  const number = ++asked;
  ui.showProgress(`Loading ${name}`);
  try {
    const found = await read();
    if (number !== asked) return;
    ui.showMessage(null);
    await present(found);
    await stage.whenDrawn();
  } catch (error) {
    if (number === asked) ui.showMessage(error.message);
    throw error;
  } finally {
    if (number === asked) ui.showProgress(null);
  }
  if (viewer.opening !== null) await settle(number);
}

/** Moves the dial from where a file was opened to what holds a frame rate, unless no dial value has half of it.
 *  Where frames are so slow that the dial would take long to get there, the largest value tells first. */
async function settle(number) {
  const dial = viewer.opening, { maxDial } = stage.model, slow = 2 * budgetOf(OPENING);
  const isOpening = () => viewer.opening !== null && number === asked;
  const keep = () => {
    ui.setDial(dial);
    ui.showNote(`Dial not moved: under ${OPENING / 2} fps at any value`);
  };
  state.dial = dial;
  const isSlow = (await stage.measure()) > slow * maxDial ** EXPONENT;
  if (isSlow && isOpening()) {
    state.dial = maxDial;
    ui.update();
    if ((await stage.measure()) > slow && isOpening()) return keep();
  }
  if (!isOpening()) return;
  ui.setHold(OPENING);
  await stage.whenDrawn();
  if (stage.hold?.outOfReach(maxDial, Math.log(2))) keep();
}

export const load = (blob, name) => open(name, () => readFile(blob, name, config.converter && convert), (read) => {
  viewer.file = null;
  show(read, null, () => []);
  ui.showName(name, null);
});

/** Opens one of the page's files: in the same view and at the same dial value, unless another scene is there. */
export async function openEntry(number) {
  const entry = viewer.files[number], base = stage.base ? null : config.base, isFirst = !stage.model;
  await open(entry.name, () => Promise.all([fetchModel(entry), base && fetchModel(base)]), async ([read, readBase]) => {
    const before = stage.model?.extent;
    if (isFirst || viewer.file === null) show(read, readBase, ownCameras);
    else {
      stage.show(read, readBase ?? undefined);
      if (!isAlike(before, stage.model.extent)) look(ownCameras());
    }
    viewer.file = number;
    ui.showName(entry.name, number);
    if (read.settings) state.dial = ui.clampDial(state.dial);
    ui.changed();
    if (isFirst && location.hash) await applyLink();
  });
}

/** The same for a control, which shows errors in the page. */
export const showFile = (number) => viewer.files[number] && stage.model && openEntry(number).catch(() => {});

export const openFile = (file) => file && load(file, file.name).catch(() => {});

for (const kind of ["dragover", "dragleave", "drop"]) {
  window.addEventListener(kind, (event) => {
    event.preventDefault();
    elements.drop.hidden = kind !== "dragover";
    if (kind === "drop") openFile(event.dataTransfer.files[0]);
  });
}

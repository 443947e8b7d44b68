// The files that the page shows: those of its server or its own, and dropped ones.
import { readGaussians } from "../../../../viewers/read.js";

const SHORTEST = 1e-15, LONGEST = 1e15; // quaternion (clod_adapter/_kernels)

/** The page's configuration; a page without one starts empty, as a viewer for dropped files. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, others: [], cameras: [], virtual_scale: null, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, metadata} of an entry of the configuration. */
const fetchModel = async ({ name, href, element }) => readFile(href ? await download(href) : included(element), name);

/** The bytes that the elements with this id have in base64; removes these elements, for their memory. */
function included(id) {
  const elements = [...document.querySelectorAll(`[id="${id}"]`)];
  if (!elements.length) throw new Error("the page does not contain its data; export the page again");
  return new Blob(elements.map((element) => {
    const characters = atob(element.textContent.trim()), bytes = new Uint8Array(characters.length);
    element.remove();
    for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
    return bytes;
  }));
}

async function download(href) {
  const response = await fetch(href).catch(() => { throw new Error("the server does not answer; start clod-adapt view again"); });
  if (response.ok) return response.blob();
  throw new Error(`the server answered ${response.status} ${response.statusText}`);
}

/** {gaussians, metadata} of a file, a Blob. */
async function readFile(blob, name) {
  const failed = (message) => { throw new Error(`${name}: ${message}`); };
  const bytes = await blob.arrayBuffer().catch(() => failed("the browser cannot read it: it is a folder or too large"));
  const refuse = ({ message }) => failed(/again$/.test(message) ? message : `${message}; clod-adapt view ${name} opens every format`);
  const read = await readGaussians(new Uint8Array(bytes)).catch(refuse), { count, settings, screenFilter, calibration } = read, gaussians = usable(read);
  if (!gaussians.count) failed("no Gaussian in it can be drawn: values are not finite or rotations are 0; export it again");
  return {
    gaussians,
    metadata: {
      name, attenuation: settings, max_sv: settings?.max_sv ?? 1, screen_filter: screenFilter, calibration,
      notes: gaussians.count < count ? `${count - gaussians.count} of ${count} Gaussians cannot be drawn and were removed` : "",
      no_dial: settings ? "" : `${name} has no sigma_d, so it has no dial; add one: clod-adapt ${name} --images SCENE`,
    },
  };
}

/** The Gaussians that can be drawn: without a value that is not finite, or a rotation too short or long. */
function usable(gaussians) {
  const { count, quats, opacityLogits } = gaussians, good = new Uint8Array(count).fill(1);
  const columns = Object.entries(gaussians).filter(([, values]) => values instanceof Float32Array);
  for (const [name, values] of columns) {
    if (name === "opacityLogits") continue; // infinite where it is opaque
    for (let k = 0; k < values.length; k++) if (!Number.isFinite(values[k])) good[Math.floor((k * count) / values.length)] = 0;
  }
  for (let i = 0; i < count; i++) {
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    if (!(norm >= SHORTEST && norm <= LONGEST && opacityLogits[i] > -Infinity)) good[i] = 0;
  }
  const rows = [...good.keys()].filter((i) => good[i]);
  if (rows.length === count) return gaussians;
  const picked = columns.map(([name, values]) => [name, values.filter((_, k) => good[Math.floor((k * count) / values.length)])]);
  return { ...gaussians, ...Object.fromEntries(picked), count: rows.length };
}

/** `show(read, base, cameras, dial)` shows another scene, `replace(read, base)` others of the same, `update()` a changed
 *  state, `settle()` moves the dial to what the device holds (main.js). */
export function createFiles(elements, viewer, config, { show, replace, update, settle, clampDial }) {
  let asked = 0, shown = 0; // numbers of openings

  /** Opens a file by `read()` and `present(what is read)`, unless one that was asked for later is there already. If reading
   *  fails, the page shows the error and keeps the previous file. */
  async function open(name, read, present) {
    const number = ++asked;
    viewer.ui.showProgress(`Loading ${name}`);
    try {
      const found = await read();
      if (number < shown) return;
      shown = number;
      viewer.ui.showMessage(null);
      await present(found);
      await viewer.stage.whenDrawn();
    } catch (error) {
      if (number >= shown) viewer.ui.showMessage(error.message);
      throw error;
    } finally {
      if (number === asked) viewer.ui.showProgress(null);
    }
  }

  /** Opens a file, a Blob. */
  async function load(blob, name) {
    await open(name, () => readFile(blob, name), (found) => {
      show(found, null, [], config.virtual_scale); // within the range of this file
      viewer.notes = found.metadata.notes;
      viewer.ui.showNote(viewer.notes);
      viewer.file = null;
      viewer.ui.showName(name, null);
    });
    await settle();
  }

  const openFile = (file) => load(file, file.name).catch(() => {});

  const showTarget = (on) => { elements.drop.hidden = !on; };
  window.addEventListener("dragover", (event) => { event.preventDefault(); showTarget(true); });
  window.addEventListener("dragleave", (event) => { if (!event.relatedTarget) showTarget(false); });
  window.addEventListener("drop", (event) => {
    event.preventDefault();
    showTarget(false);
    const [file] = event.dataTransfer.files;
    if (file) openFile(file);
  });

  const fetchBoth = (entry, base) => () => Promise.all([fetchModel(entry), base && fetchModel(base)]);
  return {
    load, openFile,
    /** Shows the configured file; `opened()` is called once it is there. */
    open: (opened) => open(config.model.name, fetchBoth(config.model, config.base), ([read, base]) => {
      show(read, base, config.cameras, config.virtual_scale);
      return opened();
    }),
    /** Shows another of the files, from the same view and at the same dial value. */
    async showFile(number) {
      const entry = viewer.files[number], { stage } = viewer;
      if (!entry || !stage.model) return;
      await open(entry.name, fetchBoth(entry, stage.base ? null : config.base), ([read, base]) => {
        if (viewer.file === null) show(read, base, config.cameras, config.virtual_scale); // a dropped one was there
        else replace(read, base);
        viewer.file = number;
        viewer.ui.showName(entry.name, number);
        if (stage.model.attenuation) stage.state.dial = clampDial(stage.state.dial);
        update();
      }).catch(() => {});
    },
  };
}

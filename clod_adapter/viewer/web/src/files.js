// The files that the page shows: those of its server or its own, and dropped ones.
import { fetchModel } from "./payload.js";
import { readFile } from "./read.js";

/** `show(read, base, cameras, dial)` shows another scene, `replace(read, base)` others of the same, `update()` a changed
 *  state, `settle()` moves the dial to what the device holds (main.js). */
export function createFiles(elements, viewer, config, { show, replace, update, settle, clampDial }) {
  const waiting = new Map(); // texts of progress, by number of the opening
  let asked = 0, shown = 0; // numbers of openings

  /** Opens a file by `read(onProgress)` and `present(what is read)`, unless one that was asked for later is there already.
   *  If reading fails, the page shows the error and keeps the previous file. */
  async function open(name, read, present) {
    const number = ++asked;
    const tell = (text) => {
      if (text) waiting.set(number, text);
      else waiting.delete(number);
      viewer.ui.showProgress([...waiting.values()].at(-1) ?? null);
    };
    try {
      tell(`Loading ${name}`);
      const found = await read((share) => tell(`Loading ${name}: ${Math.floor(100 * share)} %`));
      if (number < shown) return;
      shown = number;
      viewer.ui.showMessage(null);
      await present(found);
      await viewer.stage.whenDrawn();
    } catch (error) {
      if (number >= shown) viewer.ui.showMessage(error.message);
      throw error;
    } finally {
      tell(null);
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

  const fetchBoth = (entry, base) => (onProgress) => Promise.all([fetchModel(entry, onProgress), base && fetchModel(base, () => {})]);
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

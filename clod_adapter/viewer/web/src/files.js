// The files that the page shows: those of its server or its own, and dropped ones.
import { readFile } from "./formats/index.js";
import { readLink } from "./link.js";
import { fetchModel } from "./payload.js";

/** `show(model, base, cameras, dial)` shows another scene, `replace(model, base)` others of the same, `update()` a changed
 *  state, `settle()` moves the dial to what the device holds (main.js). */
export function createFiles(elements, viewer, config, { show, replace, update, settle, reset, clampDial }) {
  const first = new AbortController(); // ends the loading of the configured file, when another is shown
  let other = new AbortController(); // ends the loading of another one, when the next is opened
  const progress = { first: null, other: null }; // texts

  function showProgress(texts) {
    Object.assign(progress, texts);
    viewer.ui.showProgress(progress.other ?? progress.first);
  }

  function fetchNamed(entry, key, signal, onPart) {
    const onProgress = (share) => showProgress({ [key]: `Loading ${entry.name}: ${Math.floor(100 * share)} %` });
    const named = (error) => { throw new Error(`${entry.name}: ${error.message}`); };
    return fetchModel(entry, { signal, onProgress, onPart }).catch(named);
  }

  /** Its signal is aborted when the next file is opened. */
  function openOther() {
    other.abort();
    other = new AbortController();
    return other.signal;
  }

  function endFirst() {
    first.abort();
    progress.first = null;
  }

  /** Shows another file, from a buffer or a promise of one; of concurrent calls, the last. If reading fails, the page shows
   *  an error and keeps the previous file. */
  async function load(buffer, name) {
    const { ui, stage } = viewer, signal = openOther();
    showProgress({ other: `Reading ${name}` });
    try {
      const read = await readFile(await buffer, name);
      if (signal.aborted) return;
      show(read, null, [], config.virtual_scale); // within the range of this file
      endFirst();
      viewer.notes = read.metadata.notes.join("; ");
      ui.showNote(viewer.notes);
      viewer.file = null;
      ui.showName(name, null);
      ui.showMessage(null);
      await stage.whenDrawn();
      await settle();
    } catch (error) {
      const message = `${name}: ${error.message}`;
      if (!signal.aborted) ui.showMessage(message);
      throw new Error(message);
    } finally {
      if (!signal.aborted) showProgress({ other: null });
    }
  }

  function openFile(file) {
    const refuse = () => { throw new Error("the browser cannot read it: it is a folder or too large"); };
    return load(file.arrayBuffer().catch(refuse), file.name).catch(() => {});
  }

  function listenForFiles() {
    const showTarget = (on) => { elements.drop.hidden = !on; };
    window.addEventListener("dragover", (event) => { event.preventDefault(); showTarget(true); });
    window.addEventListener("dragleave", (event) => { if (!event.relatedTarget) showTarget(false); });
    window.addEventListener("drop", (event) => {
      event.preventDefault();
      showTarget(false);
      const [file] = event.dataTransfer.files;
      if (file) openFile(file);
    });
  }

  listenForFiles();
  return {
    load, openFile,
    /** Shows the configured file, its first rows while it loads; `opened()` is called once something is shown. Ends early
     *  if another file is shown meanwhile. */
    async open(opened) {
      const { file, wipe } = readLink(location.hash), { camera } = viewer, poseOf = () => JSON.stringify(camera.pose);
      let pose = null;
      async function showRead(read, base) {
        if (first.signal.aborted) return;
        if (pose) {
          replace(read, base);
          if (poseOf() !== pose || config.cameras.length) return update();
          reset(); // the coarse scene may have another extent
          pose = poseOf();
        } else {
          show(read, base, config.cameras, config.virtual_scale);
          pose = poseOf();
          await opened();
        }
      }
      const inParts = file === 0 && wipe === null; // a link to a comparison or another file needs these
      const fetchFirst = (entry, onPart) => entry && fetchNamed(entry, "first", first.signal, onPart);
      try {
        await showRead(...await Promise.all([fetchFirst(config.model, inParts && showRead), fetchFirst(config.base)]));
      } catch (error) {
        if (!first.signal.aborted) throw error;
      } finally {
        showProgress({ first: null });
      }
    },
    /** Shows another of the files, from the same view and at the same dial value. */
    async showFile(number) {
      const entry = viewer.files[number], { stage, ui } = viewer, fromDropped = viewer.file === null;
      if (!entry || !stage.model) return;
      const signal = openOther(), fetchOther = (each) => each && fetchNamed(each, "other", signal);
      try {
        const [read, base] = await Promise.all([entry, !stage.base && config.base].map(fetchOther));
        if (signal.aborted) return;
        if (fromDropped) show(read, base, config.cameras, config.virtual_scale);
        else replace(read, base);
        endFirst();
        viewer.file = number;
        ui.showName(entry.name, number);
        if (stage.model.attenuation) stage.state.dial = clampDial(stage.state.dial);
        update();
        await stage.whenDrawn();
      } catch (error) {
        if (!signal.aborted) ui.showMessage(error.message);
      } finally {
        if (!signal.aborted) showProgress({ other: null });
      }
    },
  };
}

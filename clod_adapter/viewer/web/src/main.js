// Starts the page, and defines `window.clod` for tests and scripts.
import { camera, setCamera } from "./camera.js";
import "./controls.js";
import { load, openEntry } from "./files.js";
import { elements, ui } from "./page.js";
import * as stage from "./stage.js";
import "./ui.js";
import { applyLink } from "./views.js";

async function start() {
  ui.start();
  stage.layOut();
  new ResizeObserver(stage.layOut).observe(elements.canvas);
  elements.canvas.addEventListener("webglcontextlost", () => ui.showMessage("The graphics device was lost; reload the page."));
  window.addEventListener("hashchange", applyLink);
  await openEntry(0);
}

const ready = start();
ready.catch(({ message }) => { // awaiting `ready` throws it too
  elements.busy.hidden = true;
  elements.panel.hidden = message.includes("WebGL2"); // without it, no control works
  ui.showMessage(message);
});

const { setDial, setEquation, setHold, setWipe } = ui, { counts, whenDrawn } = stage;
window.clod = {
  ready, setDial, setEquation, setHold, setWipe, counts, whenDrawn, load: (buffer, name) => load(new Blob([buffer]), name),
  /** Reproduces a camera of the configuration exactly, until the view moves. */
  setCamera(entry) {
    const { K, width, height } = entry;
    setCamera(entry);
    camera.intrinsics = { fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width, height };
    stage.change();
  },
  async capture() {
    await whenDrawn();
    stage.redraw();
    return elements.canvas.toDataURL("image/png");
  },
};

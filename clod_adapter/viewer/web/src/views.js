// Changes of the view by keys, buttons and links.
import { readLink, writeLink } from "./link.js";
import { upOfCameras } from "./up.js";
import { unit } from "./vector.js";

/** `viewer`: camera, cameras, stage, motion, ui, up (main.js); `update()` shows a changed state. */
export function createViews(elements, viewer, { update, showFile, clampDial }) {
  const axisOf = (value) => (value ? value.split(",").map(Number) : upOfCameras(viewer.cameras) ?? viewer.stage.model.extent.up);

  const views = {
    reset() {
      viewer.motion.stop();
      viewer.camera.fit(viewer.stage.model.extent, viewer.cameras, axisOf(viewer.up));
      viewer.camera.intrinsics = null; // fills the window
      viewer.cameraNumber = 0;
      viewer.ui.selectCamera(0);
      update();
    },
    /** Whether the calibration tells of such a view: it is of the cameras', if there are any to compare with. */
    isCalibrated: () => !viewer.cameras.length || viewer.camera.isNear(viewer.cameras),
    nextCamera(step) {
      const { length } = viewer.cameras;
      if (length) views.goTo((viewer.cameraNumber + step + length) % length);
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
        viewer.ui.showNote(viewer.file === null ? "Link copied; it contains the view, not the file" : "Link copied");
      } catch {
        viewer.ui.showNote("The link is in the address bar"); // file:// pages may not write to the clipboard
      }
    },
    /** Shows the view of a link, by its fragment. */
    async applyLink(hash) {
      const { file, eye, forward, down, fov, aspect, up, distance, dial, equation, wipe, other } = readLink(hash);
      const { camera, stage } = viewer;
      if (viewer.file !== null && file !== viewer.file) await showFile(file);
      viewer.motion.stop();
      if (up) [viewer.up, camera.up] = [String(up), unit(up)];
      if (eye && forward) {
        camera.pose = { ...camera.pose, eye, forward, down, aspect };
        viewer.ui.selectCamera(null);
      }
      camera.fov = fov ?? camera.fov;
      camera.distance = distance ?? camera.distance;
      stage.setHold(null);
      if (dial !== null || wipe !== null || !equation) viewer.opening = null;
      const { attenuation } = stage.model, comparable = wipe !== null && (attenuation || stage.base);
      Object.assign(stage.state, {
        dial: clampDial(dial ?? stage.state.dial), equation, wipe: comparable ? Math.min(Math.max(wipe, 0), 1) : null,
        other: other === "base" || !attenuation ? "base" : clampDial(other),
      });
      update();
    },
  };
  return views;
}

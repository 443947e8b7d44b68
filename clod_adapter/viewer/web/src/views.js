// Changes of the view by keys, buttons and links, and what plays: the path through the photographs, the turntable, and
// recordings of them.
import { createCamera } from "./camera.js";
import { readLink, writeLink } from "./link.js";
import { download, record } from "./media.js";
import { upOfCameras } from "./up.js";
import { cross, unit } from "./vector.js";

/** `viewer`: camera, cameras, stage, motion, ui, up, recording (main.js); `update()` shows a changed state. */
export function createViews(elements, viewer, { update, showFile, clampDial }) {
  const axisOf = (value) => (value ? value.split(",").map(Number) : upOfCameras(viewer.cameras) ?? viewer.stage.model.extent.up);
  const fileName = (suffix) => `${viewer.stage.model.name.replace(/\.[^.]*$/, "")}_s${viewer.stage.state.dial.toFixed(2)}.${suffix}`;

  function select(number) {
    if (number !== null) viewer.cameraNumber = number;
    viewer.ui.selectCamera(number);
  }

  function playOnce(ended) {
    const { cameras, motion, camera, ui } = viewer;
    if (cameras.length < 2) motion.turntable(1, ended);
    else motion.path(posesOf(cameras, camera), select, ended);
    ui.update();
  }

  const views = {
    reset() {
      viewer.motion.stop();
      viewer.camera.fit(viewer.stage.model.extent, viewer.cameras, axisOf(viewer.up));
      viewer.camera.intrinsics = null; // fills the window
      select(0);
      update();
    },
    nextCamera(step) {
      const { length } = viewer.cameras;
      if (length) views.goTo((viewer.cameraNumber + step + length) % length);
    },
    goTo(number) {
      viewer.motion.stop();
      viewer.camera.set(viewer.cameras[number]);
      viewer.camera.intrinsics = null;
      select(number);
      update();
    },
    /** `value`: "x,y,z" of an axis; "" for that of the cameras or the scene. */
    setUp(value) {
      viewer.motion.stop();
      viewer.up = value;
      viewer.camera.setUp(axisOf(value));
      select(null);
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
      const { file: [number] = [1], eye, axes, fov, up, distance, dial, equation, wipe } = readLink(hash), { camera, stage } = viewer;
      if (viewer.file !== null && number - 1 !== viewer.file) await showFile(number - 1);
      viewer.motion.stop();
      if (up) [viewer.up, camera.up] = [String(up), unit(up)];
      if (eye && axes) {
        const down = axes.slice(3);
        camera.pose = { ...camera.pose, eye, down, forward: cross(axes.slice(0, 3), down) };
        select(null);
      }
      if (fov) [camera.fov, camera.aspect] = fov;
      if (distance) [camera.distance] = distance;
      stage.setHold(null);
      if (dial || wipe || !equation) viewer.opening = null;
      const comparable = wipe && (stage.model.attenuation || stage.base);
      Object.assign(stage.state, { equation, wipe: comparable ? Math.min(Math.max(wipe[0], 0), 1) : null, dial: clampDial(dial?.[0] ?? stage.state.dial) });
      update();
    },
    /** Plays the path through the photographs or, without any, a turn about the pivot; stops what plays. */
    play() {
      if (viewer.motion.running) viewer.motion.stop();
      else playOnce(views.play); // again and again
    },
    turntable() {
      if (viewer.motion.running) return viewer.motion.stop();
      select(null);
      viewer.motion.turntable(Infinity);
      viewer.ui.update();
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
      stage.state.steady = !recording;
      if (recording) {
        viewer.recording = null;
        motion.stop();
        const { blob, suffix } = await recording.stop();
        download(blob, fileName(suffix));
      } else {
        viewer.recording = record(elements.canvas);
        playOnce(() => viewer.recording && views.record());
      }
      update();
    },
  };
  return views;
}

function posesOf(cameras, { distance, up }) {
  const each = Object.assign(createCamera(), { up });
  return cameras.map((entry) => {
    each.set(entry);
    return { ...each.pose, distance };
  });
}

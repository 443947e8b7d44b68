// What plays: the path through the photographs, the turntable, and recordings of them.
import { createCamera } from "./camera.js";
import { download, record } from "./media.js";

/** `viewer`: camera, cameras, stage, motion, recording (main.js); `update()` shows a changed state. */
export function createPlayback(elements, viewer, update) {
  const fileName = (suffix) => `${viewer.stage.model.name.replace(/\.[^.]*$/, "")}_s${viewer.stage.state.dial.toFixed(2)}.${suffix}`;

  function playOnce(ended) {
    const { cameras, motion, camera, ui } = viewer;
    const select = (number) => {
      viewer.cameraNumber = number;
      ui.selectCamera(number);
    };
    if (cameras.length < 2) motion.turntable(1, ended);
    else motion.path(posesOf(cameras, camera), select, ended);
    ui.update();
  }

  const playback = {
    /** Plays the path through the photographs or, without any, a turn about the pivot; stops what plays. */
    play() {
      if (viewer.motion.running) viewer.motion.stop();
      else playOnce(playback.play); // again and again
    },
    turntable() {
      if (viewer.motion.running) return viewer.motion.stop();
      viewer.ui.selectCamera(null);
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
      playOnce(() => viewer.recording && playback.record());
      update();
    },
  };
  return playback;
}

function posesOf(cameras, { distance, up }) {
  const each = Object.assign(createCamera(), { up });
  return cameras.map((entry) => {
    each.set(entry);
    return { ...each.pose, distance };
  });
}

// The rarer controls of the panel, which the button with three dots shows.

/** `viewer`: stage, motion, cameras, up, recording (main.js). `records`: whether this browser can record a video. */
export function createMenu(elements, viewer, actions, records) {
  const { stage, motion } = viewer, dialogs = ["immersive-vr", "immersive-ar"].map((mode) => [mode, document.getElementById(mode)]);

  function update() {
    const { state, model } = stage;
    elements.marks.disabled = !model?.attenuation;
    elements.marks.checked = state.marks;
    elements.up.value = viewer.up;
    elements.up.options[0].textContent = viewer.cameras.some(({ placed }) => !placed) ? "as in the photographs" : "found from the scene";
    elements.play.classList.toggle("playing", motion.running);
    elements.turn.textContent = motion.running ? "Stop" : "Turntable";
    elements.record.textContent = viewer.recording ? "Stop recording" : "Record video";
  }

  elements.menuOpen.addEventListener("click", () => {
    elements.menu.hidden = !elements.menu.hidden;
    elements.menuOpen.setAttribute("aria-expanded", !elements.menu.hidden);
    actions.layOut();
  });
  elements.marks.addEventListener("change", () => actions.setMarks(elements.marks.checked));
  elements.up.addEventListener("change", () => actions.setUp(elements.up.value));
  const clicks = {
    play: actions.play, turn: actions.turntable, picture: actions.savePicture, record: actions.record, link: actions.copyLink, full: actions.fullScreen,
  };
  for (const [name, action] of Object.entries(clicks)) elements[name].addEventListener("click", () => action());
  for (const [mode, button] of dialogs) button.addEventListener("click", () => actions.enter(mode));
  elements.record.hidden = !records;
  elements.full.hidden = !document.fullscreenEnabled; // false on iPhones

  return {
    update,
    /** Shows a button for each mode of immersive sessions that is there. */
    showModes(modes) { for (const [mode, button] of dialogs) button.hidden = !modes.includes(mode); },
  };
}

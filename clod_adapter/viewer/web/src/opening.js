// Moves the dial from where a file is opened to what suits the device. A touch of the dial ends it.

const FPS = 30; // for which the dial is moved
const HOPELESS = Math.log(2); // excess at the largest dial value, above which it is not moved
const integer = new Intl.NumberFormat("en").format;

/** The name of the device's budget in the configuration: of desktop browsers, those that say no more are the larger. */
function deviceOf({ userAgent }) {
  if (/OculusBrowser|PicoBrowser|Wolvic/.test(userAgent)) return "quest3";
  return window.matchMedia("(pointer: coarse)").matches ? "phone" : "desktop";
}

/** `viewer`: stage, ui, opening, notes (main.js). `devices`: Gaussians by device. */
export function createOpening(viewer, actions, devices) {
  const budget = devices[deviceOf(navigator)] ?? Infinity;

  /** Shows the notes on the file again, which the end of the hold has removed, and what became of the dial. */
  const note = (...moved) => viewer.ui.showNote([viewer.notes, ...moved].filter(Boolean).join("; "));

  /** The model at the time of the call, with whether another has been opened, or the dial touched, since. */
  function opened() {
    const { model } = viewer.stage;
    return [model, () => viewer.opening === null || viewer.stage.model !== model];
  }

  async function follow(least, counted) {
    const { stage } = viewer, [, ended] = opened();
    stage.setHold(FPS, least);
    await stage.whenDrawn();
    if (ended()) return;
    const { dial } = stage.state, moved = dial !== viewer.opening && `Moved to s = ${dial.toFixed(2)} for ${FPS} fps on this device`;
    actions.setHold(null);
    note(moved || counted);
  }

  const opening = {
    isOverBudget: () => viewer.stage.model.count > budget,
    /** Moves the dial to the count for such devices, and then, after this has returned, to the frame rate; says so. */
    async settle() {
      const { stage } = viewer, [model, ended] = opened();
      if (!model?.attenuation || ended()) return;
      if (!opening.isOverBudget()) return void follow(1, "");
      const { dial, kept } = await model.dialFor(stage.view(), budget);
      if (ended()) return;
      viewer.opening = stage.state.dial = dial;
      follow(dial, `Opened at s = ${dial.toFixed(2)}, with ${integer(kept)} Gaussians for such devices`);
    },
    /** Takes the excess at the largest dial value while the rate is held: the dial returns where it is out of reach. */
    held(excess) {
      if (excess <= HOPELESS) return;
      actions.setDial(viewer.opening);
      note(`Dial not moved: under ${FPS / 2} fps at any value`);
    },
  };
  return opening;
}

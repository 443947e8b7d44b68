// The panel: its texts and its controls. All controls are native, so that keys and screen readers work.

const TICKS = 1000, BELOW = 100; // of a slider: to s = 1 in equal steps of s, which begins at 0, and then of log s
const integer = new Intl.NumberFormat("en").format;

export const elementsOf = (document) =>
  new Proxy({}, { get: (_, name) => document.getElementById(name.replace(/[A-Z]/g, (c) => `-${c.toLowerCase()}`)) });

const ticksBelow = (maxDial) => (maxDial > 1 ? BELOW : TICKS);
function toDial(tick, maxDial) {
  const below = ticksBelow(maxDial);
  return tick <= below ? tick / below : maxDial ** ((tick - below) / (TICKS - below));
}
function toTick(dial, maxDial) {
  const below = ticksBelow(maxDial);
  return Math.round(dial <= 1 ? dial * below : below + ((TICKS - below) * Math.log(dial)) / Math.log(maxDial));
}

/** PSNR at a dial value, interpolated linearly in log s between the calibration's rows; null outside their range. */
function psnrAt(rows, dial) {
  const next = rows.findIndex((row) => row.virtual_scale >= dial), [a, b] = [rows[next - 1], rows[next]];
  if (b?.virtual_scale === dial) return b.psnr;
  return a && b ? a.psnr + (Math.log(dial / a.virtual_scale) / Math.log(b.virtual_scale / a.virtual_scale)) * (b.psnr - a.psnr) : null;
}

/** `viewer`: stage, motion, cameras, up, recording; `actions`: the functions that the controls call (main.js). */
export function createUi(elements, viewer, actions, canRecord) {
  const { stage } = viewer, { state } = stage, { wipe, wipeLeft, wipeRight, message } = elements;
  const { dial, hold, rate, equation, compare, target, files, camera, up, fold } = elements;
  const maxDial = () => stage.model?.max_sv ?? 1;
  const named = () => (!state.equation ? "off" : state.dial === 0 ? "all" : `s = ${state.dial.toFixed(2)}`);

  /** Shows the present state on the controls. */
  function update() {
    const { model } = stage, hasDial = Boolean(model?.attenuation);
    for (const name of ["dial", "rate", "hold", "target", "equation"]) elements[name].disabled = !hasDial;
    for (const name of ["reset", "move", "menuOpen"]) elements[name].disabled = !model;
    elements.compare.disabled = !hasDial && !stage.base;
    elements.compare.checked = state.wipe !== null;
    elements.compareWith.textContent = stage.base ? "Compare with the base" : "Compare without the dial";
    elements.target.placeholder = hasDial ? `e.g. ${integer(Math.ceil(model.count / 2))}` : "";
    elements.noDial.textContent = model?.no_dial ?? "";
    dial.value = toTick(hasDial ? state.dial : 1, maxDial());
    elements.dialValue.textContent = hasDial ? named() : "";
    dial.setAttribute("aria-valuetext", elements.dialValue.textContent || "none");
    elements.equation.checked = state.equation && hasDial;
    elements.hold.checked = stage.holds;
    elements.move.textContent = actions.isFlying() ? "Fly" : "Orbit";
    elements.canvas.classList.toggle("flying", actions.isFlying());
    elements.up.value = viewer.up;
    elements.up.options[0].textContent = viewer.cameras.some(({ placed }) => !placed) ? "as in the photographs" : "found from the scene";
    elements.play.classList.toggle("playing", viewer.motion.running);
    elements.turn.textContent = viewer.motion.running ? "Stop" : "Turntable";
    elements.record.textContent = viewer.recording ? "Stop recording" : "Record video";
    wipe.hidden = wipeLeft.hidden = wipeRight.hidden = state.wipe === null;
    wipe.style.left = `${100 * state.wipe}%`;
    wipe.setAttribute("aria-valuenow", Math.round(100 * state.wipe));
  }

  /** Whether the calibration tells of such a view: it is of the cameras', if there are any to compare with. */
  const isCalibrated = () => !viewer.cameras.length || viewer.camera.isNear(viewer.cameras);

  /** Shows count, frame time and PSNR of the last frame. */
  function updateFrame() {
    const { model } = stage, { total, kept } = stage.counts(), other = stage.otherCounts();
    const share = `${((100 * kept) / total).toFixed(kept === total ? 0 : 1)} %`;
    elements.counts.textContent = total ? `${integer(kept)} of ${integer(total)} kept (${share})` : "";
    elements.frame.textContent = stage.frameMs === null ? "" : `${stage.frameMs.toFixed(stage.frameMs < 10 ? 1 : 0)} ms per frame`;
    const psnr = model?.attenuation && state.equation && isCalibrated() ? psnrAt(model.calibration, state.dial) : null;
    elements.quality.textContent = psnr === null ? "" : `${psnr.toFixed(1)} dB`;
    if (!other) return;
    wipeLeft.textContent = `${model.attenuation ? named() : model.name} · ${integer(kept)}`;
    wipeRight.textContent = `${stage.base ? "base" : "dial off"} · ${integer(other.kept)}`;
  }

  function moveWipe(position) {
    state.wipe = Math.min(Math.max(position, 0), 1);
    stage.change({ moving: true });
    update();
  }

  function toggle(part, button) {
    part.hidden = !part.hidden;
    button.setAttribute("aria-expanded", !part.hidden);
    actions.layOut();
  }

  function openFile() {
    const [file] = elements.file.files;
    elements.file.value = "";
    if (file) actions.openFile(file);
  }

  const holdRate = (on) => actions.setHold(on ? Number(elements.rate.value) : null);
  const toggleControls = () => toggle(elements.more, elements.fold);
  const toggleComparison = () => actions.setWipe(state.wipe === null ? 0.5 : null);
  const heard = [
    [dial, "input", () => actions.setDial(toDial(dial.value, maxDial()))],
    [hold, "change", () => holdRate(hold.checked)], [rate, "change", () => holdRate(true)],
    [equation, "change", () => actions.setEquation(equation.checked)], [compare, "change", toggleComparison],
    [target, "change", () => actions.setTarget(target.value)],
    [target, "keydown", ({ key }) => key === "Enter" && actions.setTarget(target.value)], // change does not fire for the same text
    [files, "change", () => actions.showFile(files.selectedIndex)], [camera, "change", () => actions.goTo(camera.selectedIndex)],
    [up, "change", () => actions.setUp(up.value)],
    [elements.file, "change", openFile],
  ];
  for (const [element, event, action] of heard) element.addEventListener(event, action);
  const clicks = {
    move: actions.toggleFlying, reset: actions.reset, open: () => elements.file.click(), helpOpen: () => elements.help.showModal(), fold: toggleControls,
    dismiss: () => { message.hidden = true; }, menuOpen: () => toggle(elements.menu, elements.menuOpen), play: actions.play, turn: actions.turntable,
    picture: actions.savePicture, record: actions.record, link: actions.copyLink, full: actions.fullScreen,
  };
  for (const [name, action] of Object.entries(clicks)) elements[name].addEventListener("click", () => action());
  elements.record.hidden = !canRecord;
  elements.full.hidden = !document.fullscreenEnabled; // false on iPhones
  if (window.matchMedia("(max-width: 34rem), (max-height: 28rem)").matches) {
    elements.more.hidden = true;
    fold.setAttribute("aria-expanded", false);
  }

  wipe.addEventListener("pointerdown", (event) => {
    wipe.setPointerCapture(event.pointerId);
    wipe.focus();
    event.preventDefault();
  });
  wipe.addEventListener("pointermove", (event) => {
    const box = wipe.parentElement.getBoundingClientRect();
    if (wipe.hasPointerCapture(event.pointerId) && state.wipe !== null) moveWipe((event.clientX - box.left) / box.width);
  });
  wipe.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    moveWipe(state.wipe + step);
  });

  const stepDial = (ticks) => actions.setDial(toDial(Math.min(Math.max(toTick(state.dial, maxDial()) + ticks, 0), TICKS), maxDial()));
  const always = {
    f: actions.fullScreen, m: toggleControls, o: clicks.open, "?": clicks.helpOpen,
    h: () => { elements.panel.hidden = !elements.panel.hidden; actions.layOut(); },
  };
  const withModel = {
    v: actions.toggleFlying, 0: actions.reset, n: () => actions.nextCamera(1), p: () => actions.nextCamera(-1), l: actions.copyLink,
    " ": actions.play, t: actions.turntable, x: actions.savePicture, c: () => compare.disabled || toggleComparison(),
  };
  const withDial = {
    r: () => holdRate(!stage.holds), e: () => actions.setEquation(!state.equation),
    "[": () => stepDial(-20), "]": () => stepDial(20),
  };
  document.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), { model } = stage;
    if (event.ctrlKey || event.metaKey || event.altKey || elements.help.open || (event.repeat && !"[]".includes(key))) return;
    if (event.target.matches("input[type=text], select") || (key === " " && event.target.matches("button, input"))) return;
    const action = always[key] ?? (model && withModel[key]) ?? (model?.attenuation && withDial[key]);
    if (!action && !/^[1-9]$/.test(key)) return;
    event.preventDefault();
    if (action) action();
    else actions.showFile(key - 1);
  });

  return {
    update, updateFrame,
    /** Shows an error message; null hides it. */
    showMessage(text) {
      message.hidden = !text;
      message.firstElementChild.textContent = text ?? "";
    },
    /** Shows the name of the file, or its number in the list where there are several; null for one that is not listed. */
    showName(name, number, names = []) {
      document.title = elements.title.textContent = name;
      if (names.length) files.replaceChildren(...names.map((each) => new Option(each)));
      files.hidden = elements.filesHelp.hidden = files.length < 2;
      elements.title.hidden = files.length > 1 && number !== null;
      files.selectedIndex = number ?? -1;
    },
    /** Lists the cameras by name, and last what is shown for a view of none, which cannot be chosen. */
    listCameras(cameras) {
      const free = new Option("free view");
      free.hidden = free.disabled = true;
      elements.cameraRow.hidden = !cameras.length;
      camera.replaceChildren(...cameras.map(({ name }) => new Option(name)), free);
    },
    /** Selects the camera of the present view in the list; null for none. */
    selectCamera(number) { camera.selectedIndex = number ?? camera.length - 1; },
    showNote(text) { elements.targetNote.textContent = text; },
    /** Shows progress in the canvas, at its top where there is a picture; null hides it. */
    showProgress(text) {
      elements.busy.hidden = !text;
      elements.busy.classList.toggle("tag", Boolean(stage.model || elements.poster));
      elements.busy.textContent = text ?? "";
    },
  };
}

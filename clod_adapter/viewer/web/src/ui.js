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
function interpolatePsnr(rows, dial) {
  const next = rows.findIndex((row) => row.virtual_scale >= dial);
  if (next < 0) return null;
  if (rows[next].virtual_scale === dial || next === 0) return rows[next].virtual_scale === dial ? rows[next].psnr : null;
  const [a, b] = [rows[next - 1], rows[next]];
  const fraction = Math.log(dial / a.virtual_scale) / Math.log(b.virtual_scale / a.virtual_scale);
  return a.psnr + fraction * (b.psnr - a.psnr);
}

/** `actions`: the functions that the controls call (main.js). */
export function createUi(elements, stage, actions) {
  const { state } = stage;
  const maxDial = () => stage.model?.max_sv ?? 1;

  /** Shows the present state on the controls. */
  function update() {
    const { model } = stage, hasDial = Boolean(model?.attenuation), mode = comparison();
    for (const control of [elements.dial, elements.rate, elements.hold, elements.target, elements.equation]) control.disabled = !hasDial;
    for (const control of [elements.reset, elements.move, elements.menuOpen]) control.disabled = !model;
    elements.compare.disabled = !hasDial && !stage.base;
    elements.compare.options[1].textContent = stage.base ? "with the base" : "without the dial";
    elements.target.placeholder = hasDial ? `e.g. ${integer(Math.ceil(model.count / 2))}` : "";
    const left = model?.leftOut ?? 0;
    elements.noDial.hidden = !model || (hasDial && !left);
    elements.noDial.textContent = [
      left ? `${integer(left)} of ${integer(left + model.count)} Gaussians do not fit on this graphics device; left out are those that the dial removes first.` : "",
      model?.no_dial ?? "",
    ].filter(Boolean).join(" ");
    setSlider(elements.dial, elements.dialValue, hasDial ? state.dial : null);
    if (hasDial && !state.equation) elements.dialValue.textContent = "off";
    elements.equation.checked = state.equation && hasDial;
    elements.hold.checked = stage.holds;
    elements.compare.value = mode;
    for (const option of elements.compare.options) option.disabled = option.value === "dial" && !hasDial;
    elements.otherRow.hidden = mode !== "dial";
    if (mode === "dial") setSlider(elements.other, elements.otherValue, state.other);
    elements.move.textContent = actions.isFlying() ? "Fly" : "Orbit";
    elements.canvas.classList.toggle("flying", actions.isFlying());
  }

  function setSlider(slider, output, dial) {
    slider.value = toTick(dial ?? 1, maxDial());
    output.textContent = dial === null ? "" : formatDial(dial);
    slider.setAttribute("aria-valuetext", dial === null ? "none" : formatDial(dial));
  }

  /** Shows count, frame time and PSNR of the last frame. */
  function updateFrame() {
    const { model } = stage, { total, kept } = stage.counts(), other = stage.otherCounts();
    elements.counts.textContent = total ? `${integer(kept)} of ${integer(total)} kept (${percent(kept, total)})` : "";
    elements.frame.textContent = stage.frameMs === null ? "" : `${stage.frameMs.toFixed(stage.frameMs < 10 ? 1 : 0)} ms per frame`;
    const psnr = model?.attenuation && state.equation && actions.isCalibrated() ? interpolatePsnr(model.calibration, state.dial) : null;
    elements.quality.textContent = psnr === null ? "" : `${psnr.toFixed(1)} dB`;
    if (!other) return;
    const left = !model.attenuation ? model.name : state.equation ? formatDial(state.dial) : "dial off";
    const right = state.other === "base" ? (stage.base ? "base" : "dial off") : state.equation ? formatDial(state.other) : "dial off";
    elements.wipeLeft.textContent = `${left} · ${integer(kept)}`;
    elements.wipeRight.textContent = `${right} · ${integer(other.kept)}`;
  }

  const comparison = () => (state.wipe === null ? "off" : state.other === "base" ? "base" : "dial");
  const formatDial = (dial) => (dial === 0 ? "all" : `s = ${dial.toFixed(2)}`);
  const percent = (kept, total) => `${((100 * kept) / total).toFixed(kept === total ? 0 : 1)} %`;

  elements.dial.addEventListener("input", () => actions.setDial(toDial(elements.dial.value, maxDial())));
  elements.other.addEventListener("input", () => actions.setWipe(state.wipe ?? 0.5, toDial(elements.other.value, maxDial())));
  const holdRate = (on) => actions.setHold(on ? Number(elements.rate.value) : null);
  elements.hold.addEventListener("change", () => holdRate(elements.hold.checked));
  elements.rate.addEventListener("change", () => holdRate(true));
  elements.equation.addEventListener("change", () => actions.setEquation(elements.equation.checked));
  elements.compare.addEventListener("change", () => actions.compare(elements.compare.value));
  elements.target.addEventListener("change", () => actions.setTarget(elements.target.value));
  elements.target.addEventListener("keydown", (event) => event.key === "Enter" && actions.setTarget(elements.target.value)); // change does not fire for the same text
  elements.files.addEventListener("change", () => actions.showFile(elements.files.selectedIndex));
  elements.camera.addEventListener("change", () => actions.goTo(elements.camera.selectedIndex));
  elements.move.addEventListener("click", actions.toggleFlying);
  elements.reset.addEventListener("click", actions.reset);
  elements.open.addEventListener("click", () => elements.file.click());
  elements.helpOpen.addEventListener("click", () => elements.help.showModal());
  elements.fold.addEventListener("click", toggleControls);
  elements.dismiss.addEventListener("click", () => { elements.message.hidden = true; });
  elements.file.addEventListener("change", () => {
    const [file] = elements.file.files;
    elements.file.value = "";
    if (file) actions.openFile(file);
  });

  function toggleControls() {
    elements.more.hidden = !elements.more.hidden;
    elements.fold.setAttribute("aria-expanded", !elements.more.hidden);
    actions.layOut();
  }
  if (window.matchMedia("(max-width: 34rem), (max-height: 28rem)").matches) {
    elements.more.hidden = true;
    elements.fold.setAttribute("aria-expanded", false);
  }

  const keys = {
    r: () => elements.hold.disabled || holdRate(!stage.holds),
    e: () => elements.equation.disabled || actions.setEquation(!state.equation),
    c: () => elements.compare.disabled || actions.compare({ off: "base", base: stage.model?.attenuation ? "dial" : "off", dial: "off" }[comparison()]),
    v: () => elements.move.disabled || actions.toggleFlying(), f: actions.fullScreen, m: toggleControls, 0: () => elements.reset.disabled || actions.reset(),
    o: () => elements.file.click(), n: () => actions.nextCamera(1), p: () => actions.nextCamera(-1),
    "[": () => stepDial(-20), "]": () => stepDial(20), "?": () => elements.help.showModal(),
    h: () => {
      elements.panel.hidden = !elements.panel.hidden;
      actions.layOut();
    },
    l: () => stage.model && actions.copyLink(), k: () => elements.marks.disabled || actions.setMarks(!state.marks),
    " ": () => stage.model && actions.play(), t: () => stage.model && actions.turntable(), x: () => stage.model && actions.savePicture(),
  };
  const stepDial = (ticks) => {
    if (stage.model?.attenuation) actions.setDial(toDial(Math.min(Math.max(toTick(state.dial, maxDial()) + ticks, 0), TICKS), maxDial()));
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || elements.help.open) return;
    if (event.repeat && !"[]".includes(event.key)) return;
    if (event.target.matches("input[type=text], select") || (event.key === " " && event.target.matches("button, input"))) return;
    const action = keys[event.key.toLowerCase()] ?? (/^[1-9]$/.test(event.key) ? () => actions.showFile(event.key - 1) : null);
    if (!action) return;
    event.preventDefault();
    action();
  });

  return {
    update, updateFrame,
    /** Shows an error message; null hides it. */
    showMessage(text) {
      elements.message.hidden = !text;
      elements.message.firstElementChild.textContent = text ?? "";
    },
    /** Shows the name of the file, or its number in the list where there are several; null for one that is not listed. */
    showName(name, number, names = []) {
      document.title = elements.title.textContent = name;
      if (names.length) elements.files.replaceChildren(...names.map((each) => new Option(each)));
      const listed = elements.files.length > 1;
      [elements.files.hidden, elements.filesHelp.hidden] = [!listed, !listed];
      elements.title.hidden = listed && number !== null;
      elements.files.selectedIndex = number ?? -1;
    },
    /** Lists the cameras by name, and last what is shown for a view of none, which cannot be chosen. */
    listCameras(cameras) {
      const free = new Option("free view");
      free.hidden = free.disabled = true;
      elements.cameraRow.hidden = !cameras.length;
      elements.camera.replaceChildren(...cameras.map(({ name }) => new Option(name)), free);
    },
    /** Selects the camera of the present view in the list; null for none. */
    selectCamera(number) { elements.camera.selectedIndex = number ?? elements.camera.length - 1; },
    showNote(text) { elements.targetNote.textContent = text; },
    /** Shows progress in the canvas, at its top where there is a picture; null hides it. */
    showProgress(text) {
      elements.busy.hidden = !text;
      elements.busy.classList.toggle("tag", Boolean(stage.model || elements.poster));
      elements.busy.textContent = text ?? "";
    },
  };
}

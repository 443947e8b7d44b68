// The panel: what is said on it, and what its controls do. Everything is a native control, so keys and readers work.

const TICKS = 1000; // of the sliders, even steps of log s
const integer = new Intl.NumberFormat("en").format;

export const elementsOf = (document) =>
  new Proxy({}, { get: (_, name) => document.getElementById(name.replace(/[A-Z]/g, (c) => `-${c.toLowerCase()}`)) });

const toDial = (tick, most) => (most > 1 ? most ** (tick / TICKS) : 1);
const toTick = (dial, most) => (most > 1 ? Math.round((TICKS * Math.log(dial)) / Math.log(most)) : 0);

/** PSNR at a dial value, linear in log s between the calibration's rows; null outside of them. */
function calibrated(rows, dial) {
  const next = rows.findIndex((row) => row.virtual_scale >= dial);
  if (next < 0) return null;
  if (rows[next].virtual_scale === dial || next === 0) return rows[next].virtual_scale === dial ? rows[next].psnr : null;
  const [a, b] = [rows[next - 1], rows[next]];
  const part = Math.log(dial / a.virtual_scale) / Math.log(b.virtual_scale / a.virtual_scale);
  return a.psnr + part * (b.psnr - a.psnr);
}

/** `actions`: what the panel asks for; see main.js. */
export function createUi(elements, stage, actions) {
  const { state } = stage;
  const most = () => stage.model?.max_sv ?? 1;

  function show() {
    const { model } = stage, dialled = Boolean(model?.attenuation), kind = comparison();
    for (const control of [elements.dial, elements.target, elements.equation]) control.disabled = !dialled;
    for (const control of [elements.reset, elements.link, elements.move]) control.disabled = !model;
    elements.compare.disabled = !dialled && !stage.base;
    elements.compare.options[1].textContent = stage.base ? "with the base" : "without the equation";
    elements.noDial.hidden = !model || dialled;
    elements.noDial.textContent = model?.no_dial ?? "";
    slide(elements.dial, elements.dialValue, dialled ? state.dial : null);
    elements.equation.checked = state.equation && dialled;
    elements.compare.value = kind;
    for (const option of elements.compare.options) option.disabled = option.value === "dial" && !dialled;
    elements.otherRow.hidden = kind !== "dial";
    if (kind === "dial") slide(elements.other, elements.otherValue, state.other);
    elements.move.textContent = actions.flying() ? "Fly" : "Orbit";
    elements.canvas.classList.toggle("flying", actions.flying());
  }

  function slide(slider, output, dial) {
    slider.value = toTick(dial ?? 1, most());
    output.textContent = dial === null ? "" : said(dial);
    slider.setAttribute("aria-valuetext", dial === null ? "none" : said(dial));
  }

  /** What has changed with the last frame. */
  function frame() {
    const { model } = stage, { total, kept } = stage.counts(), other = stage.otherCounts();
    elements.counts.textContent = total ? `${integer(kept)} of ${integer(total)} kept (${share(kept, total)})` : "";
    elements.frame.textContent = stage.frameMs === null ? "" : `${stage.frameMs.toFixed(stage.frameMs < 10 ? 1 : 0)} ms a frame`;
    const psnr = model?.attenuation && state.equation ? calibrated(model.calibration, state.dial) : null;
    elements.quality.textContent = psnr === null ? "" : `${psnr.toFixed(1)} dB`;
    if (!other) return;
    const left = !model.attenuation ? model.name : state.equation ? said(state.dial) : "equation off";
    const right = state.other === "base" ? (stage.base ? "base" : "equation off") : state.equation ? said(state.other) : "equation off";
    elements.wipeLeft.textContent = `${left} · ${integer(kept)}`;
    elements.wipeRight.textContent = `${right} · ${integer(other.kept)}`;
  }

  const comparison = () => (state.wipe === null ? "off" : state.other === "base" ? "base" : "dial");
  const said = (dial) => `s = ${dial.toFixed(2)}`;
  const share = (kept, total) => `${((100 * kept) / total).toFixed(kept === total ? 0 : 1)} %`;

  elements.dial.addEventListener("input", () => actions.setDial(toDial(elements.dial.value, most())));
  elements.other.addEventListener("input", () => actions.setWipe(state.wipe ?? 0.5, toDial(elements.other.value, most())));
  elements.equation.addEventListener("change", () => actions.setEquation(elements.equation.checked));
  elements.compare.addEventListener("change", () => actions.compare(elements.compare.value));
  elements.target.addEventListener("change", () => actions.setTarget(elements.target.value));
  elements.target.addEventListener("keydown", (event) => event.key === "Enter" && actions.setTarget(elements.target.value)); // also the same again
  elements.camera.addEventListener("change", () => actions.goTo(elements.camera.selectedIndex));
  elements.move.addEventListener("click", actions.toggleFlying);
  elements.reset.addEventListener("click", actions.reset);
  elements.link.addEventListener("click", actions.copyLink);
  elements.open.addEventListener("click", () => elements.file.click());
  elements.full.hidden = !document.fullscreenEnabled; // iPhones have none
  elements.full.addEventListener("click", actions.fullScreen);
  elements.helpOpen.addEventListener("click", () => elements.help.showModal());
  elements.fold.addEventListener("click", fold);
  elements.dismiss.addEventListener("click", () => { elements.message.hidden = true; });
  elements.file.addEventListener("change", () => {
    const [file] = elements.file.files;
    elements.file.value = "";
    if (file) actions.openFile(file);
  });

  function fold() {
    elements.more.hidden = !elements.more.hidden;
    elements.fold.setAttribute("aria-expanded", !elements.more.hidden);
  }
  if (window.matchMedia("(max-width: 34rem), (max-height: 28rem)").matches) fold();

  const keys = {
    e: () => elements.equation.disabled || actions.setEquation(!state.equation),
    c: () => elements.compare.disabled || actions.compare({ off: "base", base: stage.model?.attenuation ? "dial" : "off", dial: "off" }[comparison()]),
    v: () => elements.move.disabled || actions.toggleFlying(), l: () => elements.link.disabled || actions.copyLink(), f: actions.fullScreen, m: fold, 0: () => elements.reset.disabled || actions.reset(),
    o: () => elements.file.click(), n: () => actions.nextCamera(1), p: () => actions.nextCamera(-1),
    "[": () => nudge(-20), "]": () => nudge(20), "?": () => elements.help.showModal(),
    h: () => { elements.panel.hidden = !elements.panel.hidden; },
  };
  const nudge = (ticks) => {
    if (stage.model?.attenuation) actions.setDial(toDial(Math.min(Math.max(toTick(state.dial, most()) + ticks, 0), TICKS), most()));
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || elements.help.open) return;
    if (event.repeat && !"[]".includes(event.key)) return;
    if (event.target.matches("input[type=text], select")) return;
    const action = keys[event.key.toLowerCase()];
    if (!action) return;
    event.preventDefault();
    action();
  });

  return {
    show, frame,
    say(text) {
      elements.message.hidden = !text;
      elements.message.firstElementChild.textContent = text ?? "";
    },
    /** The cameras to go to, by their names. */
    list(cameras) {
      elements.cameraRow.hidden = !cameras.length;
      elements.camera.replaceChildren(...cameras.map(({ name }) => new Option(name)));
    },
    /** The camera that the view is of; null where it is of none. */
    at(number) { elements.camera.selectedIndex = number ?? -1; },
    note(text) { elements.targetNote.textContent = text; },
    busy(text) {
      elements.busy.hidden = !text;
      elements.busy.textContent = text ?? "";
    },
  };
}

// The panel: what is said on it, and what its controls do. Everything is a native control, so keys and readers work.

const TICKS = 1000; // of the sliders, even steps of log s
const integer = new Intl.NumberFormat("en").format;

export const elementsOf = (document) =>
  new Proxy({}, { get: (_, name) => document.getElementById(name.replace(/[A-Z]/g, (c) => `-${c.toLowerCase()}`)) });

const toDial = (tick, most) => (most > 1 ? most ** (tick / TICKS) : 1);
const toTick = (dial, most) => (most > 1 ? Math.round((TICKS * Math.log(dial)) / Math.log(most)) : 0);

/** `actions`: what the panel asks for; see main.js. */
export function createUi(elements, stage, actions) {
  const { state } = stage;
  const most = () => stage.model?.max_sv ?? 1;

  function show() {
    const { model } = stage;
    const dialled = Boolean(model?.attenuation);
    for (const control of [elements.dial, elements.target, elements.equation]) control.disabled = !dialled;
    elements.noDial.hidden = !model || dialled;
    elements.noDial.textContent = model?.no_dial ?? "";
    elements.dial.value = toTick(state.dial, most());
    elements.dial.setAttribute("aria-valuetext", `s = ${state.dial.toFixed(2)}`);
    elements.dialValue.textContent = dialled ? `s = ${state.dial.toFixed(2)}` : "";
    elements.dialEnd.textContent = dialled ? `s = ${most()}` : "";
    elements.equation.checked = state.equation && dialled;
    elements.compare.value = state.wipe === null ? "off" : state.other === "base" ? "base" : "dial";
    for (const option of elements.compare.options) option.disabled = option.value === "dial" && !dialled;
    elements.other.hidden = elements.compare.value !== "dial";
    if (state.other !== "base") elements.other.value = toTick(state.other, most());
    elements.move.textContent = actions.flying() ? "Fly" : "Orbit";
    elements.move.setAttribute("aria-pressed", actions.flying());
  }

  function frame() {
    const { total, kept } = stage.counts(), other = stage.otherCounts();
    elements.counts.textContent = total ? `${integer(kept)} of ${integer(total)} (${share(kept, total)})` : "";
    elements.frame.textContent = stage.frameMs === null ? "" : `${stage.frameMs.toFixed(stage.frameMs < 10 ? 1 : 0)} ms a frame`;
    if (!other) return;
    elements.wipeLeft.textContent = `${stage.model.attenuation && state.equation ? `s = ${state.dial.toFixed(2)}` : "as stored"} · ${integer(kept)}`;
    elements.wipeRight.textContent = `${state.other === "base" ? "base" : `s = ${state.other.toFixed(2)}`} · ${integer(other.kept)}`;
  }

  const share = (kept, total) => `${((100 * kept) / total).toFixed(kept === total ? 0 : 1)} %`;

  elements.dial.addEventListener("input", () => actions.setDial(toDial(elements.dial.value, most())));
  elements.other.addEventListener("input", () => actions.setWipe(state.wipe ?? 0.5, toDial(elements.other.value, most())));
  elements.equation.addEventListener("change", () => actions.setEquation(elements.equation.checked));
  elements.compare.addEventListener("change", () => actions.compare(elements.compare.value));
  elements.target.addEventListener("change", () => actions.setTarget(elements.target.value));
  elements.move.addEventListener("click", actions.toggleFlying);
  elements.reset.addEventListener("click", actions.reset);
  elements.link.addEventListener("click", actions.copyLink);
  elements.open.addEventListener("click", () => elements.file.click());
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
    elements.body.hidden = !elements.body.hidden;
    elements.fold.textContent = elements.body.hidden ? "Show" : "Hide";
    elements.fold.setAttribute("aria-expanded", !elements.body.hidden);
  }

  const keys = {
    e: () => elements.equation.disabled || actions.setEquation(!state.equation),
    c: () => actions.compare({ off: "base", base: stage.model?.attenuation ? "dial" : "off", dial: "off" }[elements.compare.value]),
    v: actions.toggleFlying, l: actions.copyLink, f: actions.fullScreen, h: fold, 0: actions.reset,
    o: () => elements.file.click(), n: () => actions.nextCamera(1), p: () => actions.nextCamera(-1),
    "[": () => nudge(-20), "]": () => nudge(20), "?": () => elements.help.showModal(),
  };
  const nudge = (ticks) => {
    if (stage.model?.attenuation) actions.setDial(toDial(Math.min(Math.max(toTick(state.dial, most()) + ticks, 0), TICKS), most()));
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || elements.help.open) return;
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
    note(text) { elements.targetNote.textContent = text; },
    busy(text) {
      elements.busy.hidden = !text;
      elements.busy.textContent = text ?? "";
    },
  };
}

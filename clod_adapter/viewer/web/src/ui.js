// The panel. In page.html, data-key names the key that clicks a control, and data-needs what it is disabled without.
import { isNear } from "./camera.js";
import { openFile, showFile } from "./files.js";
import { config, elements, state, ui, viewer } from "./page.js";
import * as stage from "./stage.js";
import * as views from "./views.js";

const TICKS = 1000, BELOW = 100; // of a slider: to s = 1 in equal steps of s, which begins at 0, and then of log s
const integer = new Intl.NumberFormat("en").format;

const maxDial = () => stage.model?.maxDial ?? 1;
const named = () => (!state.equation ? "off" : state.dial === 0 ? "all" : `s = ${state.dial.toFixed(2)}`);

const toDial = (tick) => (tick <= BELOW ? tick / BELOW : maxDial() ** ((tick - BELOW) / (TICKS - BELOW)));
const toTick = (dial) => (dial <= 1 ? dial * BELOW : BELOW + ((TICKS - BELOW) * Math.log(dial)) / Math.log(maxDial()));

/** PSNR at a dial value, interpolated linearly in log s between the calibration's rows; null outside their range. */
function psnrAt(rows, dial) {
  const next = rows.findIndex((row) => row.virtual_scale >= dial), [a, b] = [rows[next - 1], rows[next]];
  if (b?.virtual_scale === dial) return b.psnr;
  if (!a || !b) return null;
  return a.psnr + (Math.log(dial / a.virtual_scale) / Math.log(b.virtual_scale / a.virtual_scale)) * (b.psnr - a.psnr);
}

function update() {
  const { model, base } = stage, hasDial = Boolean(model?.attenuation);
  const has = { model: Boolean(model), dial: hasDial, comparison: hasDial || Boolean(base) };
  for (const each of document.querySelectorAll("[data-needs]")) each.disabled = !has[each.dataset.needs];
  elements.compare.checked = state.wipe !== null;
  elements.compareWith.textContent = base ? "Compare with the base" : "Compare without the dial";
  const command = `clod-adapt ${model?.name} --images SCENE`;
  elements.noDial.textContent = !model || hasDial ? "" : `${model.name} has no sigma_d, so it has no dial; add one: ${command}`;
  elements.dial.value = toTick(hasDial ? state.dial : 1);
  elements.dialValue.textContent = hasDial ? named() : "";
  elements.dial.setAttribute("aria-valuetext", elements.dialValue.textContent || "none");
  elements.equation.checked = state.equation && hasDial;
  elements.target.placeholder = hasDial ? `e.g. ${integer(Math.ceil(model.count / 2))}` : "";
  elements.hold.checked = stage.hold !== null;
  elements.move.textContent = viewer.flying ? "Fly" : "Orbit";
  elements.canvas.classList.toggle("flying", viewer.flying);
  elements.up.value = viewer.up;
  elements.up.options[0].textContent = viewer.photographs.length ? "as in the photographs"
    : model?.extent.isStated ? "as the file states" : "found from the scene";
  elements.cameraRow.hidden = !viewer.cameras.length;
  elements.play.classList.toggle("playing", views.isRunning());
  elements.turn.textContent = views.isRunning() ? "Stop" : "Turntable";
  elements.record.textContent = viewer.recording ? "Stop recording" : "Record video";
  for (const name of ["wipe", "wipeLeft", "wipeRight"]) elements[name].hidden = state.wipe === null;
  elements.wipe.value = TICKS * state.wipe;
}

/** Shows count, frame time and PSNR of the last frame; the PSNR is of the cameras' views, if there are cameras. */
function updateFrame() {
  elements.poster?.remove(); // the picture for the time until the first frame
  const { model, base, frameMs } = stage, { total, kept } = stage.counts();
  const share = `${((100 * kept) / total).toFixed(kept === total ? 0 : 1)} %`;
  elements.counts.textContent = total ? `${integer(kept)} of ${integer(total)} kept (${share})` : "";
  elements.frame.textContent = frameMs === null ? "" : `${frameMs.toFixed(frameMs < 10 ? 1 : 0)} ms per frame`;
  const tells = model?.attenuation && state.equation && (!viewer.cameras.length || isNear(viewer.cameras));
  const psnr = tells ? psnrAt(model.calibration, state.dial) : null;
  elements.quality.textContent = psnr === null ? "" : `${psnr.toFixed(1)} dB to the ${model.against}`;
  if (state.wipe === null) return;
  elements.wipeLeft.textContent = `${model.attenuation ? named() : model.name} · ${integer(kept)}`;
  elements.wipeRight.textContent = `${base ? "base" : "dial off"} · ${integer(stage.counts(1).kept)}`;
}

/** Removes the note and the number to keep, unless it is being typed: they were of a former view or dial value. */
function forget() {
  showNote("");
  if (document.activeElement !== elements.target) elements.target.value = "";
}

/** Shows a changed state. */
function changed() {
  forget();
  stage.change();
  update();
}

/** A frame was measured for the held frame rate. */
function heldFrame(outOfReach) {
  update();
  showNote(outOfReach ? `s = ${maxDial()}, the largest trained value, is too slow for this frame rate` : "");
}

const clampDial = (dial) => Math.min(Math.max(dial, 0), maxDial());

function setDial(dial) {
  state.dial = dial;
  setHold(null);
}

/** Holds a frame rate by the dial, frames per second; null ends that. */
function setHold(fps) {
  viewer.opening = null;
  if (fps) [state.equation, elements.rate.value] = [true, fps];
  stage.setHold(fps);
  changed();
}

function setEquation(on) {
  state.equation = on;
  if (on) changed();
  else setHold(null); // no dial value changes a frame's time then
}

/** Compares with the base, or with the model without its dial, right of a share of the width; null ends that. */
function setWipe(position) {
  if (position !== null && !stage.base) state.equation = true; // else both sides would be the same
  state.wipe = position;
  changed();
}

/** The number of Gaussians that a text such as 20,000, 20k or 20% asks for; NaN for another text. */
function countOf(text) {
  const plain = text.trim().replaceAll(/[\s,_.'](?=\d{3}(?!\d))/g, "");
  const [, number, unit = ""] = /^(\d*\.?\d+)\s*([km%]?)$/i.exec(plain) ?? [];
  const count = number * { "": 1, k: 1e3, m: 1e6, "%": stage.counts().total / 100 }[unit.toLowerCase()];
  return unit === "%" ? Math.round(count) : Number(count.toFixed(6)); // 1.1 * 1e3 is no integer
}

/** Sets the dial value that keeps a typed number of Gaussians in this view. */
async function setTarget({ value }) {
  if (!value.trim()) return showNote("");
  const target = countOf(value);
  if (!(Number.isInteger(target) && target > 0)) return showNote("Enter a number of Gaussians, such as 20000, 20k or 20%");
  const { dial, kept } = await stage.model.dialFor(stage.view(), target), count = integer(kept);
  state.equation = true;
  setDial(dial);
  elements.target.value = value;
  showNote(`s = ${dial.toFixed(3)}${kept > target ? ", the largest trained value," : ""} keeps ${count} in this view`);
}

const toggle = (button) => button.setAttribute("aria-expanded", button.ariaExpanded !== "true");
const place = (change) => (button) => { change(button); stage.layOut(); };
const stepDial = (ticks) => setDial(toDial(Math.min(Math.max(toTick(state.dial) + ticks, 0), TICKS)));

/** Listens to the controls, each by its id. */
function start() {
  const actions = {
    dial: ({ value }) => setDial(toDial(value)), lower: () => stepDial(-20), raise: () => stepDial(20),
    hold: ({ checked }) => setHold(checked ? elements.rate.value : null), rate: ({ value }) => setHold(value),
    equation: ({ checked }) => setEquation(checked), compare: ({ checked }) => setWipe(checked ? 0.5 : null),
    wipe: ({ value }) => setWipe(value / TICKS), target: setTarget, files: ({ selectedIndex }) => showFile(selectedIndex),
    camera: ({ selectedIndex }) => views.goTo(selectedIndex), up: ({ value }) => views.setUp(value),
    next: () => views.goBy(1), previous: () => views.goBy(-1), move: () => { viewer.flying = !viewer.flying; update(); }, reset: views.reset,
    open: () => elements.file.click(), file: (input) => { openFile(input.files[0]); input.value = ""; }, helpOpen: () => elements.help.showModal(),
    fold: place(toggle), menuOpen: toggle, hide: place(() => { elements.panel.hidden = !elements.panel.hidden; }),
    dismiss: () => showMessage(null), play: views.play, turn: views.turn, picture: views.savePicture,
    record: views.record, link: views.copyLink, full: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()),
  };
  for (const [name, action] of Object.entries(actions)) {
    const element = elements[name], kind = element.localName === "button" ? "click" : element.type === "range" ? "input" : "change";
    element.addEventListener(kind, () => action(element));
  }
  elements.target.addEventListener("keydown", ({ key }) => key === "Enter" && setTarget(elements.target)); // the same text again
  elements.record.hidden = !views.videoType;
  elements.full.hidden = !document.fullscreenEnabled; // false on iPhones
  if (window.matchMedia("(max-width: 34rem), (max-height: 28rem)").matches) toggle(elements.fold);
  document.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), control = document.querySelector(`[data-key="${CSS.escape(key)}"]`);
    if (event.ctrlKey || event.metaKey || event.altKey || elements.help.open || (event.repeat && !"[]".includes(key))) return;
    if (event.target.matches("input[type=text], select") || (key === " " && event.target.matches("button, input"))) return;
    if (!control && !/^[1-9]$/.test(key)) return;
    event.preventDefault();
    if (control) control.click();
    else showFile(key - 1);
  });
  elements.files.replaceChildren(...viewer.files.map(({ name }) => new Option(name)));
  elements.files.hidden = elements.filesHelp.hidden = viewer.files.length < 2;
  showName(config.title, 0);
  update();
}

/** Shows the name of the file, and its number in the list; null for one that is not listed. */
function showName(name, number) {
  document.title = elements.title.textContent = name;
  elements.title.hidden = viewer.files.length > 1 && number !== null;
  elements.files.selectedIndex = number ?? -1;
}

/** Lists the cameras by name, and last what is shown for a view of none, which cannot be chosen. */
function listCameras() {
  const free = Object.assign(new Option("free view"), { hidden: true, disabled: true });
  elements.camera.replaceChildren(...viewer.cameras.map(({ name }) => new Option(name)), free);
}

/** Shows an error message; null hides it. */
function showMessage(text) {
  elements.message.hidden = !text;
  elements.message.firstElementChild.textContent = text ?? "";
}

const showNote = (text) => { elements.targetNote.textContent = text; };

/** Shows progress in the canvas, at its top where there is a picture; null hides it. */
function showProgress(text) {
  elements.busy.hidden = !text;
  elements.busy.classList.toggle("tag", Boolean(stage.model || elements.poster));
  elements.busy.textContent = text ?? "";
}

Object.assign(ui, {
  changed, clampDial, forget, heldFrame, listCameras, setDial, setEquation, setHold, setWipe, showFile, showMessage, showName, showNote,
  showProgress, start, update, updateFrame,
});

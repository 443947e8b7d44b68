// Pointer, wheel, touch and keys on the canvas, which orbit or fly the camera.
import { camera, move, rotate, viewOf, zoom } from "./camera.js";
import { elements, viewer } from "./page.js";
import { movedByHand } from "./views.js";

const ROTATION = 0.005, KEY_ROTATION = 1.3; // radians per pixel, and per second
const MIN_PRESS = 1 / 30; // seconds that a key press counts for at least
const KEYS = { // right, down, forward
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], pageup: [0, -1, 0], pagedown: [0, 1, 0],
};
const ZOOMS = { "+": -1, "=": -1, "-": 1 };
const ARROWS = { arrowleft: [1, 0], arrowright: [-1, 0], arrowup: [0, 1], arrowdown: [0, -1] };

const pointers = new Map(), pressed = new Map(); // keys by code, because Shift changes event.key
let last = 0, fast = false;

function drag({ pointerId, clientX: x, clientY: y, shiftKey }) {
  const before = pointers.get(pointerId), dx = x - before?.x, dy = y - before?.y;
  if (!dx && !dy) return; // nor without a pressed button
  const now = { ...before, x, y };
  if (pointers.size === 2) pinch(pointerId, before, now);
  else if (before.button === 0 && !shiftKey) turn(-dx * ROTATION, -dy * ROTATION);
  else pan(dx, dy);
  pointers.set(pointerId, now);
  movedByHand();
}

const turn = (yaw, pitch) => rotate(yaw, pitch, !viewer.flying);

function pan(dx, dy) {
  const pixel = camera.distance / viewOf(elements.canvas.clientWidth, elements.canvas.clientHeight).fx;
  move(-dx * pixel, -dy * pixel, 0);
}

/** Two fingers: pans with their centre and zooms with their distance. */
function pinch(id, before, now) {
  const other = [...pointers].find(([key]) => key !== id)[1];
  const gap = (point) => Math.max(Math.hypot(point.x - other.x, point.y - other.y), 1);
  pan((now.x - before.x) / 2, (now.y - before.y) / 2);
  dolly(gap(before) / gap(now));
}

function dolly(factor) {
  if (viewer.flying) move(0, 0, camera.distance * (1 - factor));
  else zoom(factor);
}

function step(time) {
  if (!pressed.size) return;
  applyKeys(Math.min((time - last) / 1000, 0.1));
  last = time;
  requestAnimationFrame(step);
}

function applyKeys(seconds) {
  const speed = camera.distance * seconds * (fast ? 3 : 0.8), angle = (viewer.flying ? -1 : 1) * KEY_ROTATION * seconds;
  for (const key of pressed.values()) {
    if (KEYS[key]) move(...KEYS[key].map((k) => k * speed));
    else if (ZOOMS[key]) dolly(Math.exp(ZOOMS[key] * seconds));
    else turn(...ARROWS[key].map((k) => k * angle));
  }
  movedByHand();
}

const { canvas } = elements;
canvas.addEventListener("pointerdown", (event) => {
  canvas.classList.add("pointed"); // without the focus ring of keys
  canvas.focus({ preventScroll: true });
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
});
canvas.addEventListener("pointermove", drag);
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  dolly(Math.exp(Math.max(-60, Math.min(60, event.deltaY * (event.deltaMode ? 20 : 1))) * 0.002));
  movedByHand();
}, { passive: false });
document.addEventListener("keydown", (event) => {
  const { target } = event, key = event.key.toLowerCase(), known = KEYS[key] || ARROWS[key] || ZOOMS[key];
  // Letters act unless the focus is on a text, a list or the dialog; other keys act on the canvas only.
  const acts = [canvas, document.body].includes(target) || (key.length === 1 && !target.closest("input[type=text], select, dialog"));
  if (event.metaKey) pressed.clear(); // macOS sends no keyup for keys released under Command
  if (!known || !acts || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  fast = event.shiftKey;
  if (pressed.has(event.code)) return;
  if (!pressed.size) {
    last = performance.now();
    requestAnimationFrame(step);
  }
  pressed.set(event.code, key);
  applyKeys(MIN_PRESS);
});
document.addEventListener("keyup", (event) => pressed.delete(event.code));
canvas.addEventListener("blur", () => canvas.classList.remove("pointed"));
for (const target of [canvas, window]) target.addEventListener("blur", () => pressed.clear());

// Pointer, wheel, touch and keys on the canvas, which orbit or fly the camera.

const ROTATION = 0.005; // radians per pixel
const MIN_PRESS = 1 / 30; // seconds that a key press counts for at least
const KEYS = { // right, down, forward
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], pageup: [0, -1, 0], pagedown: [0, 1, 0],
};
const ZOOMS = { "+": -1, "=": -1, "-": 1 };
const ARROWS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };

/** Calls `onMove()` after every change of the camera. Returns the mode, {flying}. */
export function createControls(canvas, camera, onMove) {
  const mode = { flying: false };
  const pointers = new Map(), pressed = new Map(); // keys by code, because Shift changes event.key
  let last = 0, fast = false;

  function drag(event) {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY, button: before.button };
    const dx = now.x - before.x, dy = now.y - before.y;
    if (!dx && !dy) return;
    if (pointers.size === 2) pinch(event.pointerId, before, now);
    else if (before.button === 0 && !event.shiftKey) rotate(dx, dy);
    else pan(dx, dy);
    pointers.set(event.pointerId, now);
    onMove();
  }

  // The same angles in both modes: orbiting rotates about the pivot, flying about the eye.
  const rotate = (dx, dy) => camera.rotate(-dx * ROTATION, -dy * ROTATION, !mode.flying);

  function pan(dx, dy) {
    const pixel = camera.distance / camera.view(canvas.clientWidth, canvas.clientHeight).fx;
    camera.move(-dx * pixel, -dy * pixel, 0);
  }

  /** Two fingers: pans with their centre and zooms with their distance. */
  function pinch(id, before, now) {
    const other = [...pointers].find(([key]) => key !== id)[1];
    const gap = (point) => Math.max(Math.hypot(point.x - other.x, point.y - other.y), 1);
    pan((now.x - before.x) / 2, (now.y - before.y) / 2);
    dolly(gap(before) / gap(now));
  }

  function dolly(factor) {
    if (mode.flying) camera.move(0, 0, camera.distance * (1 - factor));
    else camera.zoom(factor);
  }

  function step(time) {
    if (!pressed.size) return;
    applyKeys(Math.min((time - last) / 1000, 0.1));
    last = time;
    requestAnimationFrame(step);
  }

  /** Applies the pressed keys for a number of seconds. */
  function applyKeys(seconds) {
    const speed = camera.distance * seconds * (fast ? 3 : 0.8);
    for (const key of pressed.values()) {
      if (KEYS[key]) camera.move(...KEYS[key].map((k) => k * speed));
      else if (ZOOMS[key]) dolly(Math.exp(ZOOMS[key] * seconds));
      else rotate(...ARROWS[key].map((k) => (mode.flying ? 1 : -1) * k * 260 * seconds));
    }
    onMove();
  }

  /** One-character keys act unless the focus is on a text, a list or the dialog; other keys act on the canvas only. */
  const accepts = (target, key) =>
    target === canvas || target === document.body || (key.length === 1 && !target.closest("input[type=text], select, dialog"));

  canvas.addEventListener("pointerdown", (event) => {
    canvas.classList.add("pointed"); // no focus ring until the focus comes by the keyboard
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
    onMove();
  }, { passive: false });
  document.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), known = KEYS[key] || ARROWS[key] || ZOOMS[key];
    if (event.metaKey) pressed.clear(); // macOS sends no keyup for keys released under Command
    if (!known || !accepts(event.target, key) || event.ctrlKey || event.metaKey || event.altKey) return;
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
  for (const target of [canvas, window]) target.addEventListener("blur", () => pressed.clear());
  canvas.addEventListener("blur", () => canvas.classList.remove("pointed"));
  return mode;
}

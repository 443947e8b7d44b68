// Pointer, wheel, touch and keys on the canvas: orbit or fly.

const TURN = 0.005; // radians a pixel
const TAP = 1 / 30; // seconds that the shortest press counts for
const KEYS = { // right, down, forward
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], pageup: [0, -1, 0], pagedown: [0, 1, 0],
};
const ZOOMS = { "+": -1, "=": -1, "-": 1 };
const ARROWS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };

/** `moved()` is called after every change of the camera. Returns {flying, reset}. */
export function createControls(canvas, camera, moved) {
  const mode = { flying: false };
  const pointers = new Map(), held = new Map(); // keys by where they are: Shift changes what they say
  let last = 0, fast = false;

  function drag(event) {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY, button: before.button };
    const dx = now.x - before.x, dy = now.y - before.y;
    if (pointers.size === 2) pinch(event.pointerId, before, now);
    else if (before.button === 0 && !event.shiftKey) turn(dx, dy);
    else pan(dx, dy);
    pointers.set(event.pointerId, now);
    moved();
  }

  // Orbiting drags the scene along, flying turns the head: the same angles, about another point.
  const turn = (dx, dy) => camera.turn(-dx * TURN, -dy * TURN, !mode.flying);

  function pan(dx, dy) {
    const pixel = (2 * camera.reach * Math.tan(camera.field / 2)) / Math.min(canvas.clientWidth, canvas.clientHeight);
    camera.move(-dx * pixel, -dy * pixel, 0);
  }

  /** Two fingers: what lies under them stays under them. */
  function pinch(id, before, now) {
    const other = [...pointers].find(([key]) => key !== id)[1];
    const gap = (point) => Math.max(Math.hypot(point.x - other.x, point.y - other.y), 1);
    pan((now.x - before.x) / 2, (now.y - before.y) / 2);
    nearer(gap(before) / gap(now));
  }

  function nearer(factor) {
    if (mode.flying) camera.move(0, 0, camera.reach * (1 - factor));
    else camera.zoom(factor);
  }

  function step(time) {
    if (!held.size) return;
    act(Math.min((time - last) / 1000, 0.1));
    last = time;
    requestAnimationFrame(step);
  }

  /** What the held keys do in so many seconds. */
  function act(seconds) {
    const speed = camera.reach * seconds * (fast ? 3 : 0.8);
    for (const key of held.values()) {
      if (KEYS[key]) camera.move(...KEYS[key].map((k) => k * speed));
      else if (ZOOMS[key]) nearer(Math.exp(ZOOMS[key] * seconds));
      else turn(...ARROWS[key].map((k) => (mode.flying ? 1 : -1) * k * 260 * seconds));
    }
    moved();
  }

  /** Letters move wherever the focus is but in a text; arrows and pages are a slider's own. */
  const listens = (target, key) =>
    target === canvas || target === document.body || (key.length === 1 && !target.closest("input[type=text], select, dialog"));

  canvas.addEventListener("pointerdown", (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
  });
  canvas.addEventListener("pointermove", drag);
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    nearer(Math.exp(Math.max(-60, Math.min(60, event.deltaY * (event.deltaMode ? 20 : 1))) * 0.002));
    moved();
  }, { passive: false });
  document.addEventListener("keydown", (event) => {
    const key = event.key.toLowerCase(), ours = KEYS[key] || ARROWS[key] || ZOOMS[key];
    if (event.metaKey) held.clear(); // macOS does not say that they are let go
    if (!ours || !listens(event.target, key) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    fast = event.shiftKey;
    if (held.has(event.code)) return;
    if (!held.size) {
      last = performance.now();
      requestAnimationFrame(step);
    }
    held.set(event.code, key);
    act(TAP);
  });
  document.addEventListener("keyup", (event) => held.delete(event.code));
  for (const target of [canvas, window]) target.addEventListener("blur", () => held.clear());
  return mode;
}

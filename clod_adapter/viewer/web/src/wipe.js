// The handle between the two compared images, moved by dragging or by the arrow keys.

export function createWipe(elements, stage) {
  const { wipe, wipeLeft, wipeRight } = elements;

  function set(position) {
    stage.state.wipe = Math.min(Math.max(position, 0), 1);
    stage.change({ moving: true });
    update();
  }

  function update() {
    const { wipe: position } = stage.state;
    wipe.hidden = wipeLeft.hidden = wipeRight.hidden = position === null;
    if (position === null) return;
    wipe.style.left = `${100 * position}%`;
    wipe.setAttribute("aria-valuenow", Math.round(100 * position));
  }

  wipe.addEventListener("pointerdown", (event) => {
    wipe.setPointerCapture(event.pointerId);
    wipe.focus();
    event.preventDefault();
  });
  wipe.addEventListener("pointermove", (event) => {
    if (!wipe.hasPointerCapture(event.pointerId) || stage.state.wipe === null) return;
    const box = wipe.parentElement.getBoundingClientRect();
    set((event.clientX - box.left) / box.width);
  });
  wipe.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    set(stage.state.wipe + step);
  });
  return { update };
}

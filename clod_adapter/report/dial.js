// Flips through the pre-rendered pictures of one view. Every frame shown was rendered; nothing is blended.
for (const dial of document.querySelectorAll(".dial")) {
  const frames = [...dial.querySelectorAll(".frames img")];
  const slider = dial.querySelector("input");
  const at = (name) => frames.find((frame) => frame.dataset.name === name);
  const values = frames.filter((frame) => !frame.dataset.name);
  const show = (frame) => {
    for (const other of frames) other.classList.toggle("on", other === frame);
    dial.querySelector(".readout b").textContent = frame.dataset.title;
    dial.querySelector(".readout span").textContent = frame.dataset.detail;
    slider.setAttribute("aria-valuetext", `${frame.dataset.title}, ${frame.dataset.detail}`);
  };
  const current = () => show(values[slider.value]);
  slider.addEventListener("input", current);
  for (const button of dial.querySelectorAll("button")) {
    const hold = (event) => { event.preventDefault(); button.classList.add("held"); show(at(button.dataset.shows)); };
    const release = () => { button.classList.remove("held"); current(); };
    button.addEventListener("pointerdown", hold);
    button.addEventListener("keydown", (event) => [" ", "Enter"].includes(event.key) && hold(event));
    for (const kind of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) button.addEventListener(kind, release);
  }
  dial.hidden = false;
  current();
}

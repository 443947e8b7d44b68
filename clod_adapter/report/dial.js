// Flips through the pre-rendered pictures of one view. Every frame shown was rendered; nothing is blended.
for (const dial of document.querySelectorAll(".dial")) {
  const frames = [...dial.querySelectorAll(".frames img")], slider = dial.querySelector("input");
  const show = (shown) => {
    const { title, detail } = shown.dataset;
    for (const frame of frames) frame.classList.toggle("on", frame === shown);
    dial.querySelector(".readout b").textContent = title;
    dial.querySelector(".readout span").textContent = detail;
    slider.setAttribute("aria-valuetext", `${title}, ${detail}`);
  };
  const current = () => show(frames[slider.value]); // the compared ones come last
  slider.addEventListener("input", current);
  for (const button of dial.querySelectorAll("button")) {
    const compared = frames.find(({ dataset }) => dataset.name === button.dataset.shows);
    button.addEventListener("pointerdown", () => show(compared));
    button.addEventListener("keydown", ({ key }) => [" ", "Enter"].includes(key) && show(compared));
    for (const kind of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) button.addEventListener(kind, current);
  }
  dial.hidden = false;
  current();
}

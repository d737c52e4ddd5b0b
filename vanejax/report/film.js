// The slider and the button of a film: they press the view's own buttons, one for each frame.
(() => {
  "use strict";
  if (document.body.dataset.viewer !== "ready") return;
  const film = document.querySelector(".film");
  const [play, slider, caption] = ["button", "input", "output"].map((tag) => film.querySelector(tag));
  const frames = [...document.querySelectorAll("button[data-pose]")];
  const stops = new Set(film.dataset.stops.split(" ").map(Number));
  const FRAME_MS = 45;
  const HALT_MS = 650; // long enough to read the caption

  function show(index) {
    slider.value = String(index);
    frames[index].click();
    caption.textContent = frames[index].textContent;
    slider.setAttribute("aria-valuetext", caption.textContent);
  }
  let timer = 0;
  function stop() {
    clearTimeout(timer);
    timer = 0;
    play.textContent = "Play";
  }
  function next() {
    const index = Number(slider.value) + 1;
    show(index);
    if (index === frames.length - 1) stop();
    else timer = setTimeout(next, stops.has(index) ? HALT_MS : FRAME_MS);
  }
  play.addEventListener("click", () => {
    if (timer) {
      stop();
      return;
    }
    if (Number(slider.value) === frames.length - 1) show(0);
    play.textContent = "Pause";
    timer = setTimeout(next, FRAME_MS);
  });
  slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
  show(0);
})();

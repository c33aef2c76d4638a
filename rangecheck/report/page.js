"use strict";
(() => {
  const store = document.getElementById("frames");
  if (!store) return;
  const frames = JSON.parse(store.textContent);
  const pictures = document.querySelectorAll("img.frame");
  const slider = document.getElementById("angle");
  const degrees = document.getElementById("degrees");
  const play = document.getElementById("play");
  const count = frames[0].length;
  const show = (index) => {
    pictures.forEach((picture) => { picture.src = frames[picture.dataset.index][index]; });
    degrees.textContent = `${Math.round((360 * index) / count)}°`;
  };
  slider.addEventListener("input", () => show(Number(slider.value)));
  let timer = 0;
  play.addEventListener("click", () => {
    const running = timer !== 0;
    play.setAttribute("aria-pressed", String(!running));
    play.textContent = running ? "Play" : "Stop";
    if (running) { clearInterval(timer); timer = 0; return; }
    timer = setInterval(() => { slider.value = String((Number(slider.value) + 1) % count); show(Number(slider.value)); }, 90);
  });
})();

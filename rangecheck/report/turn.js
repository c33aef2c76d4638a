/* Turntables: every material at the azimuth of the slider, which the 3-D view shares. */
(() => {
  const slider = byId("angle");
  if (!slider) return;
  const degrees = byId("degrees"), play = byId("play"), pictures = [...document.querySelectorAll("img.turned")];
  const show = (azimuth) => {
    const turned = ((Math.round(azimuth) % 360) + 360) % 360;
    slider.value = String(turned);
    degrees.textContent = `${turned}°`;
    pictures.forEach((picture, i) => {
      const { frames, start, step } = data.tables[i], frame = frames[Math.round((((turned - start) % 360) + 360) % 360 / step) % frames.length];
      if (picture.src !== frame) picture.src = frame;
    });
  };
  slider.addEventListener("input", () => { show(Number(slider.value)); tell("azimuth", Number(slider.value), show); });
  when("azimuth", show);
  let running = 0, last = 0;
  const turn = (now) => {
    const azimuth = (Number(slider.dataset.exact ?? slider.value) + (now - last) * 0.045) % 360;
    last = now;
    slider.dataset.exact = String(azimuth);
    show(azimuth);
    tell("azimuth", azimuth, show);
    running = requestAnimationFrame(turn);
  };
  play.addEventListener("click", () => {
    const start = !running;
    play.setAttribute("aria-pressed", String(start));
    play.textContent = start ? "Stop" : "Turn";
    if (start) { last = performance.now(); slider.dataset.exact = slider.value; running = requestAnimationFrame(turn); }
    else { cancelAnimationFrame(running); running = 0; delete slider.dataset.exact; }
  });
})();

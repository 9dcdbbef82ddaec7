// Plays the frames around the worst moment in a loop. With reduced motion it stands at the worst frame until it is played.
"use strict";
{
  const { rate, numbers, paths, index } = JSON.parse(document.getElementById("moving").textContent);
  const player = document.getElementById("player"), [button, slider, output] = player.children;
  const figures = document.querySelectorAll("#figures svg");
  const HOLD_S = 0.4;  // the worst frame and the last stay so much longer
  let shown = index, isPlaying = !matchMedia("(prefers-reduced-motion: reduce)").matches && numbers.length > 1, due = 0;

  const show = (n) => {
    shown = n;
    figures.forEach((figure, k) => {
      for (const [name, path] of Object.entries(paths[n][k])) figure.querySelector(`path.${name}`).setAttribute("d", path);
    });
    slider.value = n;
    output.textContent = `frame ${numbers[n]}${n === index ? ", the worst" : ""}`;
  };
  const play = (now) => {
    if (!isPlaying) return;
    if (now >= due) {
      show((shown + 1) % numbers.length);
      due = Math.max(now - 100, due) + 1000 * (1 / rate + (shown === index || shown === numbers.length - 1 ? HOLD_S : 0));
    }
    requestAnimationFrame(play);
  };
  const start = (value) => {
    isPlaying = value;
    button.textContent = value ? "Pause" : "Play";
    if (value) requestAnimationFrame((now) => { due = now; play(now); });
  };
  button.addEventListener("click", () => start(!isPlaying));
  slider.addEventListener("input", () => { start(false); show(Number(slider.value)); });
  player.hidden = numbers.length < 2;
  show(index);
  start(isPlaying);
}

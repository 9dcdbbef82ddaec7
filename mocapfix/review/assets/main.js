/** Entry of the page: connects its elements with the actions. */

import { App } from "./app.js";
import { find, recall, remember } from "./elements.js";
import { listenForKeys } from "./keys.js";
import { listenInTakes } from "./panels.js";
import { applyTheme, listenForTheme } from "./theme.js";

const CLICK_PX = 4;
const BUTTONS = {
  "open-takes": "toggleTakes", clean: "clean", export: "exportFiles", approve: "approve", theme: "switchTheme", help: "showHelp",
  end: "end", play: "togglePlayback",
};

function connectButtons(app) {
  for (const [id, action] of Object.entries(BUTTONS)) find(id).addEventListener("click", () => app.run(action));
  for (const button of document.querySelectorAll("[data-action]")) {
    button.addEventListener("click", () => app.run(button.dataset.action));
  }
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => app.run("setView", button.dataset.view));
  }
  for (const box of document.querySelectorAll("#layers input")) box.addEventListener("change", () => app.run("showLayers"));
  find("curve-marker").addEventListener("change", (event) => {
    app.setMarker(Number(event.target.value));
    event.target.blur();
  });
  // a click leaves the focus where it is, so that Space goes on to play and pause
  document.addEventListener("mousedown", (event) => {
    if (event.target.closest("header button, #views, #layers, #playback button, #decide, #correct, #difference button")) event.preventDefault();
  });
  find("scrub").addEventListener("pointerup", (event) => event.target.blur());
}

function connectHint() {
  const hint = find("hint");
  hint.hidden = recall("hint") === "hidden";
  find("close-hint").addEventListener("click", () => {
    hint.hidden = true;
    remember("hint", "hidden");
  });
}

function connectScene(app) {
  const canvas = find("scene");
  let pressed = null;
  const pick = (event) => (app.samples ? app.scene.pick(app.samples, app.frame, event.offsetX, event.offsetY) : null);
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) return;
    const hovered = pick(event), before = app.hovered;
    if (hovered?.layer === before?.layer && hovered?.index === before?.index) return;
    app.hovered = hovered;
    app.requestDraw();
  });
  canvas.addEventListener("pointerleave", () => {
    app.hovered = null;
    app.requestDraw();
  });
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointerup", (event) => {
    const isClick = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < CLICK_PX;
    const picked = isClick ? pick(event) : null;
    if (picked?.layer === "unlabelled") app.trajectory = picked.index;
    else if (picked) app.setMarker(picked.index);
  });
  new ResizeObserver(() => app.requestDraw()).observe(canvas);
}

const app = new App();
applyTheme(app);
listenForTheme(app);
connectButtons(app);
connectHint();
connectScene(app);
listenForKeys(app);
listenInTakes();
find("changes").focus({ preventScroll: true });

function getState() {
  const { take, selected, correction, frame, marker, stretch, playback, samples, edits } = app;
  return {
    take, selected, correction, frame, stretch, marker: take?.labels[marker] ?? null, isPlaying: playback.isPlaying, speed: playback.speed,
    waiting: edits.waiting, listed: app.list.listed.map(({ id }) => id), loaded: samples ? samples.isLoaded.filter(Boolean).length : 0,
  };
}

window.review = {
  app,
  getFrameRate: () => app.playback.measuredRate,
  getState,
  get state() {
    return getState();
  },
};
app.start();

// The keys of the page.

import { isDialogOpen } from "./dialogs.js";

const isTyping = (target) => target.matches("input:not([type=checkbox]):not([type=range]), textarea, select");

export function followKeys(app) {
  const { playback, scene } = app;
  const actions = {
    a: () => app.decide("accept"), r: () => app.decide("reject"), k: () => app.decide("keep"), A: () => app.limit.accept(),
    ",": () => app.limit.change(-1), ".": () => app.limit.change(1), Enter: () => app.toggleFold(), z: () => app.toggleZoom(), i: () => app.curves.changeQuantity(),
    m: () => app.note(), w: () => app.mark("wrong"), x: () => app.mark("missing"), s: () => app.swap(), u: () => app.assign(),
    g: () => app.requestFill(), Delete: () => app.removeCorrection(), c: () => app.clean(), e: () => app.export(), p: () => app.approve(),
    t: () => app.toggleTakes(), n: () => app.openNextTake(), d: () => app.switchTheme(), q: () => app.end(),
    "?": () => app.showHelp(), h: () => app.showHelp(),
    ArrowDown: () => app.selectNeighbour(1), ArrowUp: () => app.selectNeighbour(-1),
    PageDown: () => app.selectInTime(1), PageUp: () => app.selectInTime(-1),
    ArrowRight: (event) => playback.moveTo(playback.frame + (event.shiftKey ? 10 : 1)),
    ArrowLeft: (event) => playback.moveTo(playback.frame - (event.shiftKey ? 10 : 1)),
    Home: () => playback.moveTo(0), End: () => playback.moveTo(app.lastFrame),
    " ": () => playback.toggle(), "+": () => playback.changeSpeed(1), "=": () => playback.changeSpeed(1), "-": () => playback.changeSpeed(-1),
    "[": () => app.setStretchEnd("first"), "]": () => app.setStretchEnd("last"), Escape: () => app.leave(),
    1: () => scene.frameMarkers(null, [0, 0.1, 1]), 2: () => scene.frameMarkers(null, [1, 0.1, 0]), 3: () => scene.frameMarkers(null, [0, 1, 0.001]),
    f: () => app.frameSelected(), 0: () => scene.frameMarkers(null),
    b: () => app.toggleLayer("before"), v: () => app.toggleLayer("after"), l: () => app.toggleLayer("labels"), o: () => app.toggleLayer("trails"),
  };
  document.addEventListener("keydown", (event) => {
    if (isDialogOpen() || (isTyping(event.target) && event.key !== "Escape")) return;
    if (event.ctrlKey || event.metaKey) {
      const key = event.key.toLowerCase(), isRedo = key === "y" || (key === "z" && event.shiftKey);
      if (!app.take || (key !== "z" && !isRedo)) return;
      event.preventDefault();
      if (isRedo) app.redo();
      else app.undo();
      return;
    }
    if (event.altKey) return;
    if ((event.key === " " || event.key === "Enter") && event.target.matches("button")) return;
    if (event.target.id === "limit" && event.key.startsWith("Arrow")) return;
    const key = event.key.length === 1 && event.key !== "A" ? event.key.toLowerCase() : event.key;
    if (!(key in actions) || !app.isReady) return;
    event.preventDefault();
    if (isTyping(event.target)) event.target.blur();
    actions[key](event);
  });
}

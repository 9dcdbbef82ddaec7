// The buttons, filters and boxes of the page.

import * as api from "./api.js";

const find = (id) => document.getElementById(id);
const DIRECTIONS = { front: [0, 0.1, 1], side: [1, 0.1, 0], top: [0, 1, 0.001] };

export function connectControls(app) {
  const actions = {
    accept: () => app.decide("accept"), reject: () => app.decide("reject"), keep: () => app.decide("keep"), note: () => app.note(),
    undo: () => app.undo(), redo: () => app.redo(), export: () => app.export(), approve: () => app.approve(), theme: () => app.switchTheme(), help: () => app.showHelp(),
    end: () => app.end(), mark: () => app.mark("wrong"), swap: () => app.swap(), assign: () => app.assign(), fill: () => app.requestFill(),
    "takes-button": () => app.toggleTakes(), "previous-change": () => app.selectInTime(-1), "next-change": () => app.selectInTime(1),
    clean: () => (app.take.run.state === "running" ? app.report(() => api.cancelCleaning(app.take.id)) : app.clean()),
    "lanes-zoom": () => app.toggleZoom(),
    "hint-close": () => { find("hint").hidden = true; },
  };
  for (const [id, action] of Object.entries(actions)) {
    find(id).addEventListener("click", () => { if (app.take || id === "help" || id === "end") action(); });
  }
  for (const id of ["filter-kind", "filter-decision", "sort"]) find(id).addEventListener("change", () => app.renderReview());
  find("filter-marker").addEventListener("input", () => app.renderReview());
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => app.scene.frameMarkers(null, DIRECTIONS[button.dataset.view]));
  }
  for (const name of ["before", "after", "skeleton", "trails", "labels"]) {
    find(`show-${name}`).addEventListener("change", (event) => {
      app.scene.shown[name] = event.target.checked;
      if (app.samples) app.showFrame(app.playback.frame);
    });
  }
  find("character").addEventListener("change", (event) => app.showCharacter(event.target.value));
  const stage = find("stage");
  stage.addEventListener("pointermove", (event) => {
    if (!app.isReady || event.buttons) return;
    const box = stage.getBoundingClientRect();
    app.hovered = app.scene.findTrajectory(event.clientX - box.left, event.clientY - box.top);
    app.placeLabels();
  });
  stage.addEventListener("dblclick", () => {
    if (!app.hovered || app.hovered.layer === "unlabelled") return;
    app.pickLane(app.hovered.index, null, false);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => app.applyTheme(localStorage.getItem("theme")));
}

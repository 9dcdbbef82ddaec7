// The filters and boxes of the page, and the pointer over the view.

const CLICK_PX = 4;
const find = (id) => document.getElementById(id);

export function connectControls(app) {
  find("hint-close").addEventListener("click", () => { find("hint").hidden = true; });
  for (const id of ["filter-kind", "filter-decision", "sort"]) find(id).addEventListener("change", () => app.renderReview());
  find("filter-marker").addEventListener("input", () => app.renderReview());
  for (const name of ["before", "after", "skeleton", "body", "sticks", "ghost", "trails", "labels", "follow"]) {
    find(`show-${name}`).addEventListener("change", (event) => {
      app.scene.shown[name] = event.target.checked;
      if (app.samples) app.showFrame(app.playback.frame);
    });
  }
  find("character").addEventListener("change", (event) => app.showCharacter(event.target.value));
  find("division").addEventListener("change", (event) => app.scene.setDivision(event.target.value));
  const stage = find("stage");
  stage.addEventListener("pointermove", (event) => {
    if (!app.isReady || event.buttons) return;
    const box = stage.getBoundingClientRect();
    app.hovered = app.scene.findTrajectory(event.clientX - box.left, event.clientY - box.top);
    app.placeLabels();
  });
  let pressed = null;
  stage.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, { capture: true });
  stage.addEventListener("click", (event) => {
    if (!app.isReady || event.target !== app.scene.canvas || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > CLICK_PX) return;
    const box = stage.getBoundingClientRect(), hit = app.scene.findTrajectory(event.clientX - box.left, event.clientY - box.top);
    if (hit) app.pickTrajectory(hit, event.ctrlKey || event.metaKey);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => app.applyTheme(localStorage.getItem("theme")));
}

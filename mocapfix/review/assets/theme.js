/** Dark or light: as the system has it, or as it was chosen here. */

import { find, recall, remember } from "./elements.js";

const dark = matchMedia("(prefers-color-scheme: dark)");

export function applyTheme(app) {
  const chosen = recall("theme");
  if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
  showTheme(app);
}

export function switchTheme(app) {
  const next = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  remember("theme", next);
  showTheme(app);
}

export function listenForTheme(app) {
  dark.addEventListener("change", () => showTheme(app));
}

function isDark() {
  const { theme } = document.documentElement.dataset;
  return theme ? theme === "dark" : dark.matches;
}

/** Draw again what takes its colours from the style sheet. */
function showTheme(app) {
  find("theme").textContent = isDark() ? "Light" : "Dark";
  app.scene.readColors();
  if (!app.take) return;
  app.bar.drawMarks();
  app.curves.redraw();
  app.showFrame();
}

/** Names of markers over the 3-D view. */

export class MarkerLabels {
  constructor(layer) {
    this.layer = layer;
    this.pool = [];
  }

  /** Place labels; `entries` are [text, place, style]. */
  place(entries) {
    while (this.pool.length < entries.length) {
      const element = document.createElement("span");
      this.layer.append(element);
      this.pool.push(element);
    }
    this.pool.forEach((element, index) => {
      const entry = entries[index];
      element.hidden = !entry;
      if (!entry) return;
      const [text, [x, y], style] = entry;
      if (element.textContent !== text) element.textContent = text;
      if (element.className !== style) element.className = style;
      element.style.transform = `translate(${Math.round(x) + 9}px, ${Math.round(y) - 22}px)`;
    });
  }
}

/** Labels of the selected, hovered and, if they are wanted, all markers. */
export function listLabels(app) {
  const { scene, samples, take, frame } = app, entries = [], listed = new Set();
  const add = (marker, style) => {
    if (listed.has(marker)) return;
    const offset = 3 * (frame * samples.markerCount + marker);
    const place = (scene.shown.after && scene.project(samples.after, offset)) || scene.project(samples.before, offset);
    if (!place) return;
    listed.add(marker);
    entries.push([take.labels[marker], place, style]);
  };
  const { hovered } = app;
  if (hovered) {
    const array = samples[hovered.layer], count = array.length / 3 / samples.frameCount;
    const place = scene.project(array, 3 * (frame * count + hovered.index));
    const isLabelled = hovered.layer !== "unlabelled";
    if (place) {
      const label = isLabelled ? take.labels[hovered.index] : take.unlabelled[hovered.index];
      entries.push([hovered.layer === "before" ? `${label} before` : label, place, "hovered"]);
      if (isLabelled) listed.add(hovered.index);
    }
  }
  for (const marker of app.listSelectedMarkers()) add(marker, "selected");
  if (scene.shown.labels) take.labels.forEach((_, marker) => add(marker, ""));
  return entries;
}

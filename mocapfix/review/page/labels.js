// The labels of markers over the 3-D view.

const find = (id) => document.getElementById(id);

// Methods of the application.
export const labelPlacement = {
  placeLabels() {
    const layer = find("label-layer");
    const indices = find("show-labels").checked ? [...this.take.labels.keys()] : [];
    const spans = indices.map((m) => ({ m, at: this.scene.projectMarker(m) })).filter((each) => each.at);
    while (layer.children.length > spans.length) layer.lastChild.remove();
    spans.forEach(({ m, at }, n) => {
      const span = layer.children[n] ?? layer.appendChild(document.createElement("span"));
      span.textContent = this.take.labels[m];
      span.style.transform = `translate(${at.x + 5}px, ${at.y - 6}px)`;
    });
    this.placeLabel(this.hovered ?? (this.marker === null ? null : { layer: "after", index: this.marker }), !this.hovered);
  },

  placeLabel(trajectory, isChosen) {
    const label = find("marker-label"), at = trajectory && this.scene.projectMarker(trajectory.index, trajectory.layer);
    label.hidden = !at;
    if (!at) return;
    label.textContent = (trajectory.layer === "unlabelled" ? this.take.unlabelled : this.take.labels)[trajectory.index];
    label.classList.toggle("chosen", isChosen);
    label.style.transform = `translate(${at.x + 9}px, ${at.y - 22}px)`;
  },
};

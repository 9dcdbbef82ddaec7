// The labels of markers over the 3-D view, and their correction by clicks: swaps of two trajectories, labels of unlabelled ones.

import { confirmAction } from "./dialogs.js";
import { AddEdit } from "./edits.js";

const find = (id) => document.getElementById(id);

// How the left and the right label of a pair differ.
const SIDES = [[/(^|[:_. -])L(?=[A-Z0-9_. -]|$)/, "$1R"], [/Left/, "Right"], [/left/, "right"], [/LEFT/, "RIGHT"]];

// Returns the pairs of left and right among labels.
export function pairSides(labels) {
  const known = new Set(labels);
  const findRight = (label) => SIDES.map(([left, right]) => label.replace(left, right)).find((each) => each !== label && known.has(each));
  return labels.map((label) => [label, findRight(label)]).filter(([, right]) => right);
}

// Returns the runs [trajectory, first, last] of measured frames of unlabelled trajectories, in order of time.
export function listUnlabelledRuns({ unlabelled, counts: { unlabelled: count }, frameCount }) {
  const runs = [];
  for (let u = 0; u < count; u++) {
    let run = null;
    for (let t = 0; t < frameCount; t++) {
      if (Number.isNaN(unlabelled[(t * count + u) * 3])) run = null;
      else if (run) run[2] = t;
      else runs.push(run = [u, t, t]);
    }
  }
  return runs.sort((a, b) => a[1] - b[1] || a[0] - b[0]);
}

// Methods of the application.
export const labelCorrection = {
  // Picks a trajectory in the view: a marker, a second one to swap with it, or an unlabelled one, which a marker's name then labels.
  pickTrajectory({ layer, index }, isAdded) {
    if (layer === "unlabelled") return this.pickRun(listUnlabelledRuns(this.samples).find(([u, , last]) => u === index && this.playback.frame <= last));
    if (!isAdded || this.marker === null || index === this.marker) return this.pickLane(index, null, false);
    this.other = index;
    const [one, other] = [this.marker, index].map((m) => this.take.labels[m]), interval = this.findSwapInterval();
    this.showStatus(interval ? `S swaps ${one} and ${other}, frames ${interval.join("–")}.` : `${one} or ${other} is missing at this frame.`, !interval);
  },

  // The frames, in the file's own numbers, from this one to the next at which one of the picked markers is missing.
  findSwapInterval() {
    const { frame } = this.playback, { samples } = this, isShown = (t) => [this.marker, this.other].every((m) => !Number.isNaN(samples.getPosition("before", t, m)[0]));
    let last = frame;
    if (!isShown(frame)) return null;
    while (last < this.lastFrame && isShown(last + 1)) last++;
    return [frame, last].map((each) => each + this.take.first_frame);
  },

  async swapPicked() {
    const interval = this.findSwapInterval(), markers = [this.marker, this.other].map((m) => this.take.labels[m]);
    if (!interval) return this.showStatus(`${markers.join(" or ")} is missing at this frame.`, true);
    this.other = null;
    await this.edits.send(new AddEdit({ kind: "swap", markers, first: interval[0], last: interval[1] }));
  },

  // Picks a run of an unlabelled trajectory.
  pickRun(run) {
    if (!run) return;
    this.run = run;
    this.showStatus(`${this.take.unlabelled[run[0]]}, ${this.nameRun().join("–")}: click the name of its marker beside the lanes, or press U.`);
    this.placeLabels();
  },

  nameRun() { return this.run.slice(1).map((each) => each + this.take.first_frame); },

  // Goes on to the next unlabelled trajectory in time.
  pickNextRun() {
    const runs = listUnlabelledRuns(this.samples), [u, first] = this.run ?? [-1, this.playback.frame];
    if (!runs.length) return this.showStatus("The take has no unlabelled trajectory.", true);
    const next = runs.find((each) => each[1] > first || (each[1] === first && each[0] > u)) ?? runs[0];
    this.playback.moveTo(next[1]);
    this.pickRun(next);
  },

  async labelRun(marker) {
    const [first, last] = this.nameRun(), markers = [this.take.labels[marker], this.take.unlabelled[this.run[0]]];
    this.run = null;
    if (this.allows("assign")) await this.edits.send(new AddEdit({ kind: "assign", markers, first, last }));
  },

  // Exchanges the labels of left and right in the chosen stretch or in the whole take, as one edit.
  async swapSides() {
    if (!this.allows("swap")) return;
    const pairs = pairSides(this.take.labels), [first, last] = (this.stretch ?? [0, this.lastFrame]).map((each) => each + this.take.first_frame);
    if (!pairs.length) return this.showStatus("No two labels differ in left and right only.", true);
    const text = `Exchange ${pairs.length} pairs of labels, such as ${pairs[0].join(" and ")}, in frames ${first} to ${last}?`;
    if (await confirmAction("Exchange left and right", text)) await this.edits.send(new AddEdit(...pairs.map((markers) => ({ kind: "swap", markers, first, last }))));
  },
};

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
    const chosen = this.run ? { layer: "unlabelled", index: this.run[0] } : this.marker === null ? null : { layer: "after", index: this.marker };
    this.placeLabel(this.hovered ?? chosen, !this.hovered);
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

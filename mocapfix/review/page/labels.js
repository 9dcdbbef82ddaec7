// The labels of markers over the 3-D view, and their correction by clicks: swaps of two trajectories, labels of unlabelled ones.

import { askExchange } from "./dialogs.js";
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

// Returns the pairs of markers of two takes that have the same name without that of the subject.
function pairSubjects(one, other) {
  const name = ({ labels, subject }) => labels.map((label) => [label.startsWith(subject) ? label.slice(subject.length + 1) : label, label]);
  const known = new Map(name(other));
  return name(one).map(([bare, label]) => [label, known.get(bare)]).filter(([, same]) => same);
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
  pickTrajectory({ layer, index, person }, isAdded) {
    if (layer === "unlabelled") return this.pickRun(listUnlabelledRuns(this.samples).find(([u, , last]) => u === index && this.playback.frame <= last));
    if (person.isChosen && (!isAdded || this.marker === null || index === this.marker)) return this.pickLane(index, null, false);
    if (!isAdded || this.marker === null) return this.showStatus(`${person.take.labels[index]}: click a marker of ${this.take.subject}, then Ctrl-click this one to swap them.`);
    this.other = { person, index };
    const interval = this.findSwapInterval(), labels = this.namePicked();
    this.showStatus(interval ? `S swaps ${labels.join(" and ")}, frames ${interval.join("–")}.` : `${labels.join(" or ")} is missing at this frame.`, !interval);
  },

  namePicked() { return [this.take.labels[this.marker], this.other.person.take.labels[this.other.index]]; },

  // The frames, in the file's own numbers, from this one to the next at which one of the picked markers is missing.
  findSwapInterval() {
    const { frame } = this.playback, { person, index } = this.other;
    const isShown = (t) => ![this.samples.getPosition("before", t, this.marker), person.samples.getPosition("before", t, index)].some(([x]) => Number.isNaN(x));
    let last = frame;
    if (!isShown(frame)) return null;
    while (last < this.lastFrame && isShown(last + 1)) last++;
    return [frame, last].map((each) => each + this.take.first_frame);
  },

  async swapPicked() {
    const interval = this.findSwapInterval(), markers = this.namePicked();
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

  // Exchanges the labels of left and right, or those of two people, in the chosen stretch or in the whole take, as one edit.
  async exchange() {
    if (!this.allows("exchange")) return;
    const people = this.scene.people.slice(1).map(({ take }) => [`${this.take.subject} and ${take.subject}`, pairSubjects(this.take, take)]);
    const choices = [["left and right", pairSides(this.take.labels)], ...people].filter(([, pairs]) => pairs.length);
    if (!choices.length) return this.showStatus("No two labels differ in left and right only, or in the subject only.", true);
    const chosen = await askExchange(choices, (this.stretch ?? [0, this.lastFrame]).map((each) => each + this.take.first_frame));
    if (chosen && (await this.edits.send(new AddEdit(...chosen)))) this.setStretch(null);
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
    const label = find("marker-label"), at = trajectory && this.scene.projectMarker(trajectory.index, trajectory.layer, trajectory.person), { take } = trajectory?.person ?? this;
    label.hidden = !at;
    if (!at) return;
    label.textContent = (trajectory.layer === "unlabelled" ? take.unlabelled : take.labels)[trajectory.index];
    label.classList.toggle("chosen", isChosen);
    label.style.transform = `translate(${at.x + 9}px, ${at.y - 22}px)`;
  },
};

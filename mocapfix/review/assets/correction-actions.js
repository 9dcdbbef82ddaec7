/** The corrections of the reviewer: stretches, labels and fills. */

import { fillFrames, fillMarkers, openDialog, readFrames } from "./dialogs.js";
import { fillOptions, find } from "./elements.js";

export class CorrectionActions {
  constructor(app) {
    this.app = app;
  }

  /** Whether edits are possible; says why not. */
  checkEditable() {
    if (this.app.isRunning) this.app.report("The take is being cleaned; decisions can be changed when that is done.", true);
    return !this.app.isRunning;
  }

  markWrong() { this.mark("wrong"); }
  markMissing() { this.mark("missing"); }

  mark(kind) {
    find("mark-kind").value = kind;
    this.openCorrection("mark", { "mark-marker": this.getLabel() }, () => ({
      kind: find("mark-kind").value, markers: [find("mark-marker").value] }));
  }

  swap() {
    const { app } = this, { labels } = app.take, markers = app.listSelectedMarkers().map((marker) => labels[marker]);
    const one = markers[0] ?? labels[0], other = markers[1] ?? guessPartner(one, labels);
    this.openCorrection("swap", { "swap-one": one, "swap-other": other }, () => {
      const both = [find("swap-one").value, find("swap-other").value];
      return both[0] === both[1] ? { problem: "Choose two markers." } : { kind: "swap", markers: both };
    });
  }

  assign() {
    const { app } = this, { unlabelled } = app.take;
    if (!unlabelled.length) {
      app.report("The take has no unlabelled trajectories.", true);
      return;
    }
    fillOptions(find("assign-trajectory"), unlabelled.map((label) => [label, label]), unlabelled[app.trajectory ?? this.findTrajectory()]);
    this.openCorrection("assign", { "assign-marker": this.getLabel() }, () => ({
      kind: "assign", markers: [find("assign-marker").value, find("assign-trajectory").value] }));
  }

  setFill() {
    this.openCorrection("fill", { "fill-marker": this.getLabel() }, () => ({
      kind: "fill", markers: [find("fill-marker").value], method: find("fill-method").value }));
  }

  /** Open the dialog of a correction with the selected stretch, else the interval that is looked at. */
  openCorrection(name, markers, read) {
    const { app } = this;
    if (!this.checkEditable()) return;
    for (const [id, label] of Object.entries(markers)) fillMarkers(id, app.take.labels, label);
    fillFrames(name, app.take, app.stretch ?? app.getInterval());
    openDialog(`dialog-${name}`, { button: "Add", submit: () => {
      const frames = readFrames(name, app.take), content = frames.problem ? frames : read();
      if (content.problem) return content.problem;
      app.setStretch(null);
      app.edits.add({ type: "add", correction: { method: null, note: "", ...content, ...frames } });
      return "";
    } });
  }

  getLabel() {
    return this.app.take.labels[Math.max(this.app.marker, 0)];
  }

  /** The unlabelled trajectory with the most samples in the interval that is looked at. */
  findTrajectory() {
    const { samples } = this.app, [first, last] = this.app.stretch ?? this.app.getInterval(), number = samples.trajectoryCount;
    const counts = new Array(number).fill(0);
    for (let frame = first; frame <= last; frame += 1) {
      for (let u = 0; u < number; u += 1) counts[u] += Number.isNaN(samples.unlabelled[3 * (frame * number + u)]) ? 0 : 1;
    }
    return counts.indexOf(Math.max(...counts));
  }

  removeCorrection(index = this.app.correction) {
    const { app } = this;
    if (index === null) app.report("No correction is selected.");
    else if (this.checkEditable()) app.edits.add({ type: "remove", index });
  }

  selectCorrectionNeighbour(step) {
    const { app } = this, last = app.take.corrections.length - 1;
    if (last >= 0) app.selectCorrection(app.correction === null ? (step > 0 ? 0 : last) : Math.min(Math.max(app.correction + step, 0), last));
  }

  startStretch() {
    const { app } = this, end = app.stretch?.[1] ?? app.frame;
    app.setStretch([app.frame, Math.max(end, app.frame)]);
  }

  endStretch() {
    const { app } = this, start = app.stretch?.[0] ?? app.frame;
    app.setStretch([Math.min(start, app.frame), app.frame]);
  }
}

const SIDES = [["L", "R"], ["l", "r"], ["Left", "Right"], ["left", "right"]];

/** The marker of the other side of the body, else any other. */
function guessPartner(label, labels) {
  for (const [left, right] of SIDES) {
    for (const [from, to] of [[left, right], [right, left]]) {
      const partner = label.replace(from, to);
      if (label.includes(from) && labels.includes(partner)) return partner;
    }
  }
  return labels.find((each) => each !== label) ?? label;
}

// What the user can do beside decisions on changes: corrections, cleaning again, export, approval.

import * as api from "./api.js";
import * as dialogs from "./dialogs.js";
import { AddEdit, RemoveEdit } from "./edits.js";

// Methods of the application.
export const correctionActions = {
  // The stretch for a correction, in the file's frame numbers: the chosen one, else that of the selected change, else this frame.
  getInterval() {
    if (this.stretch) return this.stretch.map((frame) => frame + this.take.first_frame);
    if (this.change) return [this.change.first, this.change.last];
    return [this.playback.frame + this.take.first_frame, this.playback.frame + this.take.first_frame];
  },

  // The frames of the selected change if it is one of the marker, else null.
  findChangeFrames() {
    const { change } = this;
    return change?.markers.includes(this.getMarkerLabel()) ? [this.toIndex(change.first), this.toIndex(change.last)] : null;
  },

  getMarkerLabel() { return this.take.labels[this.marker ?? 0]; },

  async add(question) {
    const correction = await question;
    if (!correction) return;
    if (await this.edits.send(new AddEdit(correction))) this.setStretch(null);
  },

  mark(kind) { return this.allows("mark") && this.add(dialogs.askMark(this.take.labels, this.getMarkerLabel(), this.getInterval(), kind)); },
  swap() {
    if (!this.allows("swap")) return false;
    if (this.other !== null && this.other !== undefined) return this.swapPicked();
    const marker = this.getMarkerLabel(), other = this.change?.markers.find((label) => label !== marker && this.take.labels.includes(label));
    const others = this.scene.people.slice(1).flatMap(({ take }) => take.labels);
    return this.add(dialogs.askSwap(this.take.labels, others, [marker, other], this.getInterval()));
  },

  // Shows the estimates of the chosen marker in the chosen stretch, or in the gap at this frame.
  requestFill() {
    if (!this.allows("fill")) return;
    const marker = this.marker ?? 0, isOfMarker = this.change?.markers.includes(this.take.labels[marker]);
    this.keys.close();
    this.scene.frameMarkers([marker]);
    if (this.curves.marker !== marker) this.curves.showMarkers([marker], null);
    const { frame } = this.playback, run = this.lanes.findRun(marker, frame);
    this.fills.open(this.take, this.samples, marker, this.stretch || isOfMarker ? this.getInterval() : run.map((each) => each + this.take.first_frame));
  },

  assign() {
    if (!this.allows("assign")) return false;
    if (this.run) return this.add(dialogs.askAssign(this.take.labels, this.take.unlabelled, this.getMarkerLabel(), this.take.unlabelled[this.run[0]], this.nameRun()));
    const named = this.change?.markers.find((label) => this.take.unlabelled.includes(label));
    return this.add(dialogs.askAssign(this.take.labels, this.take.unlabelled, this.getMarkerLabel(), named, this.getInterval()));
  },

  removeCorrection(index = this.correctionIndex) {
    if (index !== null && this.allows("mark")) this.edits.send(new RemoveEdit(index));
  },
};

export const outputActions = {
  async clean(options = {}) {
    if (!this.allows("clean")) return;
    await this.edits.last;
    await this.report(async () => this.showRun(await api.startCleaning(this.take.id, options)));
  },

  async export() {
    if (!this.allows("export")) return;
    const chosen = await dialogs.askExport(this.take);
    if (!chosen) return;
    this.exported = ["extra_formats", "rigs", "characters"].flatMap((name) => (chosen[name] ? chosen[name].split(",") : []));
    await this.clean(chosen);
  },

  async approve() {
    if (!this.allows("approve")) return;
    if (this.take.approval?.is_current) {
      const { name, date } = this.take.approval;
      if (!(await dialogs.confirmAction("Withdraw the approval", `${name} approved this take on ${date}. Withdraw the approval?`))) return;
      return this.report(async () => this.applyReview(this.take, await api.approveTake(this.take.id, null)));
    }
    const name = await dialogs.askName(this.session?.reviewer ?? "");
    if (name !== null) await this.report(async () => this.applyReview(this.take, await api.approveTake(this.take.id, name)));
  },

  async end() {
    await this.edits.last;
    await this.report(api.closeReview);
    this.cover("The review has ended. You can close this page.");
  },

  // Runs a request and shows its error.
  async report(action) {
    try {
      await action();
    } catch (error) {
      this.showStatus(error.message, true);
    }
  },
};

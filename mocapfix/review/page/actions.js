// What the user can do beside decisions on changes: corrections, cleaning again, export, approval.

import * as api from "./api.js";
import * as dialogs from "./dialogs.js";

// Methods of the application.
export const correctionActions = {
  // The stretch for a correction, in the file's frame numbers: the chosen one, else that of the selected change, else this frame.
  getInterval() {
    if (this.stretch) return this.stretch.map((frame) => frame + this.take.first_frame);
    if (this.change) return [this.change.first, this.change.last];
    return [this.playback.frame + this.take.first_frame, this.playback.frame + this.take.first_frame];
  },

  getMarkerLabel() { return this.take.labels[this.marker ?? 0]; },

  async add(question) {
    const correction = await question;
    if (!correction) return;
    if (await this.edits.send({ type: "add", correction: { note: "", ...correction } })) this.setStretch(null);
  },

  mark(kind) { return this.add(dialogs.askMark(this.take.labels, this.getMarkerLabel(), this.getInterval(), kind)); },
  swap() { return this.add(dialogs.askSwap(this.take.labels, [this.getMarkerLabel(), this.change?.markers[1]].filter(Boolean), this.getInterval())); },
  requestFill() { return this.add(dialogs.askFill(this.take.labels, this.getMarkerLabel(), this.getInterval())); },

  assign() {
    if (!this.take.unlabelled.length) return this.showStatus("The take has no unlabelled trajectory.", true);
    const named = this.change?.markers.find((label) => this.take.unlabelled.includes(label));
    return this.add(dialogs.askAssign(this.take.labels, this.take.unlabelled, this.getMarkerLabel(), named, this.getInterval()));
  },

  removeCorrection(index = this.correctionIndex) {
    if (index !== null) this.edits.send({ type: "remove", index });
  },
};

export const outputActions = {
  async clean(formats = [], rigs = []) {
    if (!this.take.can_clean) return this.showStatus(this.take.cannot_clean_reason, true);
    await this.edits.last;
    await this.report(async () => this.showRun(await api.startCleaning(this.take.id, formats, rigs)));
  },

  async export() {
    const chosen = await dialogs.askExport(this.take.export);
    if (chosen && (chosen.formats.length || chosen.rigs.length)) {
      this.exported = [...chosen.formats, ...chosen.rigs];
      await this.clean(chosen.formats, chosen.rigs);
    }
  },

  async approve() {
    if (this.take.approval?.is_current) {
      const { name, date } = this.take.approval;
      if (!(await dialogs.confirmAction("Withdraw the approval", `${name} approved this take on ${date}. Withdraw the approval?`))) return;
      return this.report(async () => this.applyReview(this.take, await api.withdrawApproval(this.take.id)));
    }
    const name = await dialogs.askName();
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

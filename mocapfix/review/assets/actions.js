/** What keys and buttons do. */

import { approveTake, cancelCleaning, closeReview, startCleaning, withdrawApproval } from "./api.js";
import { CorrectionActions } from "./correction-actions.js";
import { confirmAction, fillChecks, openDialog, readChecks } from "./dialogs.js";
import { count, find, recall, remember } from "./elements.js";
import { listKeys } from "./keys.js";
import { renderDifference, renderTakes } from "./panels.js";
import { switchTheme } from "./theme.js";

export class Actions extends CorrectionActions {
  accept() { this.decide("accept"); }
  reject() { this.decide("reject"); }
  keep() { this.decide("keep"); }

  /** Decide on the selected change, and go to the next that is not reviewed. */
  decide(decision) {
    const { app } = this, change = app.getChange();
    if (!change) return app.report("No change is selected.", true);
    if (app.correction !== null) return app.report("A correction is selected; ↑ or ↓ goes back to the change.", true);
    if (!this.checkEditable()) return undefined;
    const next = app.list.findNextOpen();
    app.edits.add({ type: "decide", ids: [change.id], decision });
    if (next && next !== change.id) app.select(next);
    else if (app.take.changes.every((each) => each.is_reviewed)) app.report("Saving … All changes are reviewed.");
    return undefined;
  }

  acceptKind() {
    const { app } = this, change = app.getChange();
    if (!change || !this.checkEditable()) return;
    const ids = app.take.changes.filter((each) => each.kind === change.kind && !each.is_reviewed).map(({ id }) => id);
    if (!ids.length) {
      app.report(`All changes of the kind ${change.kind} are reviewed.`);
      return;
    }
    confirmAction(`Accept ${count(ids.length, "change")} of the kind ${change.kind} that you have not reviewed?`, "Accept", () => {
      app.edits.add({ type: "decide", ids, decision: "accept" });
    });
  }

  writeNote() {
    const { app } = this, change = app.getChange();
    if (!change || !this.checkEditable()) return;
    find("note-text").value = change.note;
    openDialog("dialog-note", {
      about: `${change.kind} ${change.markers.join(", ")}, frames ${change.first} to ${change.last}`, button: "Save",
      submit: () => { app.edits.add({ type: "note", id: change.id, text: find("note-text").value.trim() }); } });
  }

  undo() {
    const { app } = this;
    if (!this.checkEditable()) return;
    if (app.take.undo_count || app.edits.waiting) app.edits.add({ type: "undo" });
    else app.report("There is nothing to undo.");
  }

  selectNeighbour(step) {
    const { app } = this, { activeElement } = document;
    if (activeElement === find("corrections")) return this.selectCorrectionNeighbour(step);
    const id = app.list.findNeighbour(app.correction === null ? step : 0);
    if (id && (id !== app.selected || app.correction !== null)) app.select(id);
    return undefined;
  }

  selectInTime(step) {
    const { app } = this, { selected } = app;
    const ordered = [...app.list.listed].sort((one, other) => one.first - other.first || one.id.localeCompare(other.id));
    const place = ordered.findIndex((change) => change.id === selected);
    const next = ordered[place < 0 ? 0 : Math.min(Math.max(place + step, 0), ordered.length - 1)];
    if (next && next.id !== selected) app.select(next.id);
  }

  togglePlayback() {
    const { app } = this;
    if (app.playback.isPlaying) app.playback.pause();
    else app.playback.play();
    app.showFrame();
  }

  step(frames) {
    const { app } = this;
    app.playback.pause();
    app.seek(Number.isFinite(frames) ? app.frame + frames : (frames > 0 ? app.take.frame_count - 1 : 0));
  }

  changeSpeed(step) {
    this.app.playback.changeSpeed(step);
    this.app.bar.update();
  }

  stepMarker(step) {
    const { app } = this, markers = app.listSelectedMarkers(), all = app.take.labels.map((_, index) => index);
    const group = (app.getChange()?.markers.length ?? 0) > 1 && markers.includes(app.marker) ? markers : all;
    app.setMarker(group[(group.indexOf(app.marker) + step + group.length) % group.length]);
  }

  setView(name) {
    const { app } = this;
    if (name === "selected") app.frameSelected(false);
    else if (name === "all") app.scene.frame(app.samples, app.frame, null, null, false);
    else app.scene.setView(name);
  }

  toggleLayer(name) {
    const box = find(`show-${name}`);
    box.checked = !box.checked;
    this.showLayers();
  }

  showLayers() {
    for (const name of Object.keys(this.app.scene.shown)) this.app.scene.shown[name] = find(`show-${name}`).checked;
    this.app.showFrame();
  }

  switchTheme() {
    switchTheme(this.app);
  }

  clean() {
    const { app } = this;
    if (app.isRunning) confirmAction("Stop the cleaning?", "Stop", () => this.attempt(async () => this.takeRun(await cancelCleaning(app.take.id))));
    else if (!app.take.can_clean) app.report(app.take.cannot_clean_reason, true);
    else this.startCleaning([], []);
  }

  startCleaning(formats, rigs) {
    const { app } = this;
    app.events.requested = [...formats, ...rigs];
    return this.attempt(async () => {
      await app.edits.idle;
      const known = app.events.runCount, run = await startCleaning(app.take.id, formats, rigs);
      if (known === app.events.runCount) this.takeRun(run);
    });
  }

  takeRun(run) {
    this.app.events.receiveRun(this.app.take.id, run);
  }

  exportFiles() {
    const { app } = this, { export: choices, can_clean: canClean, cannot_clean_reason: reason } = app.take;
    if (!this.checkEditable()) return;
    if (!canClean) {
      app.report(reason, true);
      return;
    }
    fillChecks(find("export-formats"), "format", choices.formats);
    fillChecks(find("export-rigs"), "rig", choices.rigs);
    openDialog("dialog-export", { button: "Export", submit: () => {
      const formats = readChecks(find("export-formats")), rigs = readChecks(find("export-rigs"));
      if (!formats.length && !rigs.length) return "Choose at least one format.";
      this.startCleaning(formats, rigs);
      return "";
    } });
  }

  approve() {
    const { app } = this, { approval, state, changes, id } = app.take;
    if (!this.checkEditable()) return;
    if (approval && state === "approved") {
      confirmAction(`Withdraw the approval by ${approval.name}?`, "Withdraw", () => this.attempt(async () => {
        this.takeApproval(id, await withdrawApproval(id), "The approval is withdrawn.");
      }));
      return;
    }
    const open = changes.filter((change) => !change.is_reviewed).length;
    find("approve-name").value = recall("name") ?? "";
    openDialog("dialog-approve", {
      about: open ? `${open} of ${count(changes.length, "change")} ${open === 1 ? "is" : "are"} not reviewed.` : "", button: "Approve",
      submit: () => {
        const name = find("approve-name").value.trim();
        if (!name) return "Write your name.";
        remember("name", name);
        this.attempt(async () => {
          await app.edits.idle;
          this.takeApproval(id, await approveTake(id, name), "Approved");
        });
        return "";
      } });
  }

  takeApproval(id, { approval, state }, text) {
    const { app } = this;
    if (app.take.id !== id) return;
    Object.assign(app.take, { approval, state });
    app.showState();
    app.report(text);
  }

  showDifference() {
    const { app } = this, panel = find("difference");
    if (!panel.hidden) panel.hidden = true;
    else if (app.take.difference) renderDifference(app);
    else app.report("The take was not cleaned again in this review.");
  }

  async toggleTakes() {
    const takes = find("takes");
    if (!takes.hidden) {
      this.closeTakes();
      return;
    }
    const row = renderTakes(this.app);
    takes.hidden = false;
    row?.focus();
    await this.refreshTakes();
  }

  closeTakes() {
    find("takes").hidden = true;
    document.activeElement?.blur();
  }

  async refreshTakes() {
    await this.attempt(() => this.app.refreshSession());
    const takes = find("takes");
    if (takes.hidden) return;
    const focused = document.activeElement?.dataset?.id, row = renderTakes(this.app);
    const same = [...takes.querySelectorAll(".row")].find((each) => each.dataset.id === focused);
    (same ?? row)?.focus();
  }

  openListedTake(id) {
    this.closeTakes();
    if (id !== this.app.take.id) this.openTake(id);
  }

  openTake(id) {
    find("difference").hidden = true;
    this.app.report("");
    return this.app.openTake(id);
  }

  openNextTake() {
    return this.attempt(async () => {
      const { app } = this;
      await app.refreshSession();
      const { takes } = app.session, place = takes.findIndex(({ id }) => id === app.take.id);
      const next = [...takes.slice(place + 1), ...takes.slice(0, Math.max(place, 0))].find(({ state }) => state !== "approved");
      if (next) await this.openTake(next.id);
      else app.report(takes.length > 1 ? "All other takes are approved." : "The folder has no other take.");
    });
  }

  showHelp() {
    listKeys(find("key-list"));
    openDialog("dialog-help", { button: "Close" });
  }

  /** Escape: close a panel, else clear the stretch. */
  leave() {
    if (!find("takes").hidden) this.closeTakes();
    else if (!find("difference").hidden) find("difference").hidden = true;
    else if (this.app.stretch) this.app.setStretch(null);
  }

  end() {
    return this.attempt(async () => {
      await this.app.edits.idle;
      await closeReview();
      this.app.close();
    });
  }

  /** Do something with the server; show the sentence if it fails. */
  async attempt(act) {
    try {
      await act();
    } catch (error) {
      this.app.report(error.message, true);
    }
  }
}

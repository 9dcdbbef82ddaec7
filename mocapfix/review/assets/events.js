/** What the server announces: edits of other pages, the progress of a cleaning, and the end. */

import { getTake } from "./api.js";
import { renderDifference } from "./panels.js";

const POLL_MS = 50;

export class Events {
  constructor(app) {
    Object.assign(this, { app, announced: "", runCount: 0, requested: [] });
  }

  receive(event) {
    const { app } = this;
    if (event.type === "closing") app.close();
    else if (event.type === "session") app.actions.refreshTakes();
    else if (event.type === "run") this.receiveRun(event.take, event.run);
    else if (event.type === "edited") this.receiveEdit(event.take, event.revision);
  }

  /** Another page may have edited the take; own edits have the revision of their reply. */
  async receiveEdit(id, revision) {
    const { app } = this;
    if (id !== app.take?.id) return;
    this.announced = revision;
    await app.edits.idle;
    if (id !== app.take.id || revision !== this.announced || revision === app.take.revision || app.edits.waiting) return;
    await app.refreshReview();
  }

  async receiveRun(id, run) {
    const { app } = this;
    if (id !== app.take?.id) return;
    this.runCount += 1;
    app.take.run = run;
    app.showState();
    if (run.state === "running") app.report(`Cleaning: ${run.stage || "starting"} …`);
    else if (run.state === "done") await this.showCleaned();
    else app.report(run.message || (run.state === "failed" ? "The cleaning failed." : "The cleaning was stopped."), run.state === "failed");
  }

  /** Load the take that was cleaned, at the same place, and show what differs. */
  async showCleaned() {
    const { app, requested } = this, { id, labels } = app.take;
    this.requested = [];
    const loaded = app.openTake(id, { frame: app.frame, selected: app.selected, label: labels[app.marker] });
    const { generation } = app;
    await Promise.race([loaded, waitForReady()]);
    if (generation !== app.generation) return;
    app.report(`Cleaned again.${requested.length ? ` Written: ${requested.join(", ")}.` : ""}`);
    if (app.take.difference) renderDifference(app);
  }

  /** Fetch what may have changed while the server did not answer. */
  async resume() {
    const { app } = this;
    app.report("The server answers again.");
    if (!app.take) {
      await app.load();
      return;
    }
    const { id } = app.take, wasRunning = app.isRunning;
    try {
      const take = await getTake(id);
      if (id !== app.take.id) return;
      if (wasRunning || take.run.state === "running") await this.receiveRun(id, take.run);
      else if (!app.edits.waiting && take.revision !== app.take.revision) app.takeOver(take);
      if (app.samples.isLoaded.includes(false)) await app.loadSamples(app.generation);
    } catch (error) {
      app.report(error.message, true);
    }
  }
}

async function waitForReady() {
  while (!document.documentElement.dataset.ready) await new Promise((resolve) => { setTimeout(resolve, POLL_MS); });
}

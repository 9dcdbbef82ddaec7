/** Edits are sent one after the other, each with the revision of the reply before. */

import { LostError, postEdit } from "./api.js";

export class EditQueue {
  /** `connection.waitForServer()` settles when the server answers; `app` holds the take and shows it. */
  constructor(app, connection) {
    this.app = app;
    this.connection = connection;
    this.pending = [];
    this.isSending = false;
    this.idle = Promise.resolve();
  }

  /** Number of edits that are not saved yet. */
  get waiting() {
    return this.pending.length;
  }

  add(action) {
    this.pending.push(action);
    this.applyPending();
    this.app.report("Saving …");
    if (!this.isSending) this.idle = this.sendAll();
    return this.idle;
  }

  async sendAll() {
    this.isSending = true;
    const { app } = this, { id } = app.take;
    while (this.pending.length && app.take.id === id) {
      try {
        const edited = await postEdit(id, app.take.revision, this.pending[0]);
        const action = this.pending.shift();
        this.takeOver(id, edited, action);
        if (!this.pending.length) app.report("Saved");
      } catch (error) {
        if (error instanceof LostError) {
          await this.connection.waitForServer();
          continue; // if the edit arrived, the revision is another, and the server answers with its state
        }
        await this.discard(id, error);
      }
    }
    this.pending = [];
    this.isSending = false;
  }

  /** Show what the server has instead of the edits that it refused. */
  async discard(id, error) {
    const others = this.pending.length - 1;
    this.pending = [];
    if (error.take) this.takeOver(id, error.take);
    else await this.app.refreshReview();
    this.app.report(`${error.message}${others > 0 ? " The edits after it were not made." : ""}`, true);
  }

  takeOver(id, edited, action) {
    if (this.app.take.id !== id) return;
    this.app.takeOver(edited, action);
    this.applyPending();
  }

  /** Show decisions at once, before they are saved. */
  applyPending() {
    let isChanged = false;
    for (const action of this.pending.filter(({ type }) => type === "decide")) {
      const ids = new Set(action.ids);
      for (const change of this.app.take.changes) {
        if (ids.has(change.id)) Object.assign(change, { decision: action.decision, is_reviewed: true });
      }
      isChanged = true;
    }
    if (isChanged) this.app.showReview();
  }
}

// Edits of the decisions: each is sent at once, one after the other, with the revision that the reply before had.

import { RequestError, sendEdit } from "./api.js";

export class EditQueue {
  constructor({ getTake, applyReview, showStatus }) {
    Object.assign(this, { getTake, applyReview, showStatus, last: Promise.resolve(), waiting: 0, lastDurationMs: 0 });
  }

  // Sends an edit of the open take; resolves to whether it was saved.
  send(action) {
    const take = this.getTake();
    if (!take) return Promise.resolve(false);
    if (take.run.state === "running") {
      this.showStatus("The take is being cleaned; edit it when that has ended.", true);
      return Promise.resolve(false);
    }
    this.waiting++;
    this.showStatus("Saving …");
    this.last = this.last.then(() => this.sendNow(take, action));
    return this.last;
  }

  async sendNow(take, action) {
    const start = performance.now();
    try {
      const review = await sendEdit(take.id, take.revision, action);
      this.applyReview(take, review);
      this.lastDurationMs = performance.now() - start;
      this.showStatus("Saved.");
      return true;
    } catch (error) {
      if (error instanceof RequestError && error.status === 409 && error.body?.take) this.applyReview(take, error.body.take);
      this.showStatus(error.message, true);
      return false;
    } finally {
      this.waiting--;
    }
  }
}

// The edits of a review, one class for each kind, and the queue that sends them: one after the other, at once, each with the
// revision that the reply before had.

import { RequestError, sendEdit } from "./api.js";

class Edit {
  // `action` is what the server receives, `text` what the page says of it.
  constructor(action, text) { Object.assign(this, { action, text }); }
}

const DONE = { accept: "Accepted", reject: "Rejected", keep: "Kept as measured" };
const countChanges = (count) => (count === 1 ? "1 change" : `${count} changes`);

export class DecideEdit extends Edit {
  constructor(changes, decision) {
    super({ type: "decide", ids: changes.map((each) => each.id), decision }, `${DONE[decision]}: ${countChanges(changes.length)}.`);
  }
}

export class NoteEdit extends Edit {
  constructor(change, text) { super({ type: "note", id: change.id, text }, `Noted on ${change.id}.`); }
}

export class AddEdit extends Edit {
  constructor(...corrections) {
    const text = `Correction "${corrections[0].kind}" added: ${corrections[0].markers.join(", ")}${corrections.length > 1 ? `, and ${corrections.length - 1} more` : ""}.`;
    super({ type: "add", corrections: corrections.map((each) => ({ note: "", ...each })) }, text);
  }
}

export class RemoveEdit extends Edit {
  constructor(index) { super({ type: "remove", index }, "Correction removed."); }
}

export class UndoEdit extends Edit {
  constructor() { super({ type: "undo" }, "Undone; Ctrl-Y makes it again."); }
}

export class RedoEdit extends Edit {
  constructor() { super({ type: "redo" }, "Made again."); }
}

export class EditQueue {
  constructor({ getTake, applyReview, showStatus }) {
    Object.assign(this, { getTake, applyReview, showStatus, last: Promise.resolve(), waiting: 0, lastDurationMs: 0 });
  }

  // Sends an edit of the open take; resolves to whether it was saved.
  send(edit) {
    const take = this.getTake();
    if (!take) return Promise.resolve(false);
    this.waiting++;
    this.last = this.last.then(() => this.sendNow(take, edit));
    return this.last;
  }

  async sendNow(take, edit) {
    const start = performance.now();
    try {
      const review = await sendEdit(take.id, take.revision, edit.action);
      this.applyReview(take, review);
      this.lastDurationMs = performance.now() - start;
      const prevented = edit.action.type === "add" && take.corrections.at(-1)?.prevented;
      this.showStatus(`Saved. ${edit.text}${prevented ? ` It is not made: ${prevented}.` : ""}`, Boolean(prevented));
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

/** The stream of events, and what the page shows when the server does not answer. */

import { getSession } from "./api.js";

const RETRY_MS = 1500, GRACE_MS = 1200;
const LOST = "The server of the review does not answer. This page tries to reach it again; edits that are not saved are kept until then. "
  + "If it has ended, start mocapfix review again and open the new address.";

export class Connection {
  constructor({ receive, resume, cover }) {
    Object.assign(this, { receive, resume, cover, isLost: false, isEnded: false, waiting: null });
  }

  open() {
    this.source?.close();
    this.source = new EventSource("api/events");
    this.source.addEventListener("open", () => this.restore());
    this.source.addEventListener("message", (event) => this.receive(JSON.parse(event.data)));
    this.source.addEventListener("error", () => {
      if (this.isEnded) return;
      this.timer ??= setTimeout(() => this.markLost(), GRACE_MS);
      if (this.source.readyState === EventSource.CLOSED) setTimeout(() => this.isEnded || this.open(), RETRY_MS);
    });
  }

  markLost() {
    if (this.isEnded) return;
    this.isLost = true;
    this.cover(LOST);
  }

  restore() {
    clearTimeout(this.timer);
    this.timer = null;
    if (!this.isLost || this.isEnded) return;
    this.isLost = false;
    this.cover("");
    this.resume();
  }

  /** Wait until the server answers again. */
  waitForServer() {
    this.waiting ??= this.retry().finally(() => { this.waiting = null; });
    return this.waiting;
  }

  async retry() {
    this.markLost();
    for (;;) {
      await new Promise((resolve) => { setTimeout(resolve, RETRY_MS); });
      try {
        await getSession();
        this.restore();
        return;
      } catch {
        // not yet
      }
    }
  }

  end() {
    this.isEnded = true;
    this.source?.close();
    this.cover("The review has ended. You can close this page.");
  }
}

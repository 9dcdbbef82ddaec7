// The estimates of a stretch of a marker, each as the next cleaning fills it, of which the reviewer takes one.

import { fetchFills } from "./api.js";
import { AddEdit } from "./edits.js";
import { getMethodColour } from "./lanes.js";

const find = (id) => document.getElementById(id);
// By the name in the changes file: that in the lanes. The last has no estimate.
const METHOD_NAMES = {
  spline: "spline", cluster: "markers near it", rigid_group: "rigid group", body: "body", gaussian_process: "similar frames", line: "straight line", empty: "leave empty",
};

export class FillPreview {
  // `onShow` is called with the estimates that are shown, `send` with an edit; it resolves to whether that was saved.
  constructor({ onShow, send, showStatus }) {
    Object.assign(this, { onShow, send, showStatus, isOpen: false, request: 0 });
  }

  // Shows the estimates of a marker over frames in the file's own numbers.
  async open(take, samples, marker, [first, last]) {
    const label = take.labels[marker], request = ++this.request;
    const what = `${label}, ${first === last ? `frame ${first}` : `frames ${first}–${last}`}`;
    Object.assign(this, { take, samples, marker, label, first, last, isOpen: true, options: [] });
    find("fills").hidden = false;
    find("fills").textContent = `Estimates of ${what} …`;
    let fills = [];
    try {
      fills = await fetchFills(take.id, label, first, last);
      if (request === this.request) this.showStatus(`Estimates of ${what}: a number takes one, Escape none.`);
    } catch (error) {
      if (request === this.request) this.showStatus(error.message, true);
    }
    if (request !== this.request) return;
    if (fills.length && fills.every((each) => !each.reason && !each.samples.some(Boolean))) {
      this.close();
      this.showStatus(`${what}: no sample is missing or faulty. Mark wrong ones first (W).`, true);
      return;
    }
    this.options = Object.entries(METHOD_NAMES).map(([method, name], n) => this.buildOption(n, method, name, fills.find((each) => each.method === method)));
    this.render(what);
  }

  buildOption(n, method, name, fill) {
    const samples = fill?.samples ?? [], from = this.first - 1 - this.take.first_frame, edges = [from, from + samples.length + 1];
    const values = new Float32Array((samples.length + 2) * 3).fill(NaN);
    samples.forEach((each, t) => values.set(each?.slice(0, 3) ?? [NaN, NaN, NaN], (t + 1) * 3));
    const isShown = (t) => t >= 0 && t < this.take.frame_count;
    edges.forEach((t, end) => { if (isShown(t)) values.set(this.samples.getPosition("after", t, this.marker), (end ? samples.length + 1 : 0) * 3); });
    const isKnown = samples.some(Boolean), refusal = fill && !isKnown ? fill.reason : "";
    return { number: n + 1, method, name, samples, refusal, isKnown, predicted_mm: fill?.predicted_mm ?? null, colour: getMethodColour(name),
      from, length: samples.length + 2, layer: { values, counts: { values: 1 } }, reason: fill?.reason ?? "" };
  }

  render(what) {
    const title = document.createElement("b"), known = this.options.map((each) => each.predicted_mm).filter((each) => each !== null);
    title.textContent = what;
    const buttons = this.options.map((each) => {
      const button = document.createElement("button"), key = document.createElement("kbd"), dot = document.createElement("i");
      dot.className = each.method === "empty" ? "key empty" : "key";
      if (each.method !== "empty") dot.style.background = each.colour;
      key.textContent = each.number;
      const predicted = each.predicted_mm === null ? "" : ` ${each.predicted_mm} mm${each.reason ? ", in part" : ""}`;
      button.append(key, " ", dot, ` ${each.name}${predicted}`);
      button.classList.toggle("best", each.predicted_mm !== null && each.predicted_mm === Math.min(...known));
      button.disabled = Boolean(each.refusal);
      button.title = each.reason || (each.predicted_mm === null ? "" : `Predicted error ${each.predicted_mm} mm`);
      button.addEventListener("click", () => this.choose(each.number));
      for (const [name, isActive] of [["pointerenter", true], ["pointerleave", false], ["focus", true], ["blur", false]]) {
        button.addEventListener(name, () => { each.isActive = isActive; this.show(); });
      }
      return button;
    });
    find("fills").replaceChildren(title, ...buttons);
    this.show();
  }

  show() { this.onShow(this.options.filter((each) => each.isKnown)); }

  // Takes the estimate of a number; returns whether there is a choice.
  choose(number) {
    const option = this.options?.[number - 1];
    if (!this.isOpen || !option) return this.isOpen;
    if (option.refusal) this.showStatus(`${option.name}: ${option.refusal}.`, true);
    else this.takeEstimate(option);
    return true;
  }

  // Estimates the fills that were taken elsewhere, or before the page was loaded, and calls draw() after each.
  async restore(take, samples, draw) {
    for (const each of take.corrections.filter((one) => one.kind === "fill" && one.is_pending && samples.claim(one))) {
      const [label] = each.markers, known = each.method === "empty" ? [] : await fetchFills(take.id, label, each.first, each.last);
      if (samples.isCancelled) return;
      samples.request(each, take.labels.indexOf(label), known.find(({ method }) => method === each.method)?.samples ?? [], METHOD_NAMES[each.method]);
      draw();
    }
  }

  async takeEstimate({ method, samples, name }) {
    const correction = { kind: "fill", markers: [this.label], first: this.first, last: this.last, method };
    this.samples.request(correction, this.marker, samples, name);
    this.close();
    await this.send(new AddEdit(correction));
  }

  close() {
    if (!this.isOpen) return;
    Object.assign(this, { isOpen: false, options: [], request: this.request + 1 });
    find("fills").hidden = true;
    this.onShow([]);
  }
}

// The samples of a take, loaded in blocks: positions before and after cleaning, joints, uncertainty and state.
// What follows from the decisions is shown at once: `after`, `sd` and `state` are as they will be once the take is cleaned again.

import { fetchSamples } from "./api.js";

const BLOCK_FRAMES = 600;
const SHIFT_KINDS = ["moved", "drift"];  // no sample differs

export const STATE = { measured: 0, filled: 1, replaced: 2, relabelled: 3, reassigned: 4, suspect: 5, empty: 6, rejected: 7 };

const describeFill = ({ markers, first, last, method, points }) => JSON.stringify([markers, first, last, method ?? points]);

export class Samples {
  constructor(take) {
    this.take = take;
    this.id = take.id;
    this.frameCount = take.frame_count;
    this.counts = { before: take.labels.length, after: take.labels.length, unlabelled: take.unlabelled.length, joints: take.joints.length };
    for (const name of ["before", "after", "unlabelled", "joints"]) {
      this[name] = new Float32Array(this.frameCount * this.counts[name] * 3).fill(NaN);
    }
    this.sd = new Float32Array(this.frameCount * this.counts.after).fill(NaN);
    this.state = new Uint8Array(this.frameCount * this.counts.after).fill(STATE.empty);
    this.cleaned = new Map();  // of samples that a decision hides, by their index: [x, y, z, sd, state] as they were cleaned
    this.requested = new Map();  // of samples that a correction fills by an estimate, by their index: the name of its method
    this.fills = new Map();  // of corrections that request a fill, by their content: [marker, [x, y, z, sd] of each frame, method]
    this.columns = new Map(take.labels.map((label, m) => [label, m]));
    this.isCancelled = false;
  }

  // Loads all blocks, that of a frame first; calls draw() after each.
  async load(frame, draw) {
    const blocks = [];
    for (let first = 0; first < this.frameCount; first += BLOCK_FRAMES) blocks.push(first);
    const start = Math.floor(frame / BLOCK_FRAMES) * BLOCK_FRAMES;
    blocks.sort((a, b) => (a === start ? -1 : b === start ? 1 : a - b));
    for (const first of blocks) {
      const data = await fetchSamples(this.id, first, BLOCK_FRAMES);
      if (this.isCancelled) return;
      this.insertBlock(first, Math.min(BLOCK_FRAMES, this.frameCount - first), data);
      draw();
    }
  }

  insertBlock(first, count, data) {
    let offset = 0;
    for (const name of ["before", "after", "unlabelled", "joints"]) {
      const width = this.counts[name] * 3;
      this[name].set(new Float32Array(data, offset, count * width), first * width);
      offset += count * width * 4;
    }
    const width = this.counts.after;
    this.sd.set(new Float32Array(data, offset, count * width), first * width);
    this.state.set(new Uint8Array(data, offset + count * width * 4, count * width), first * width);
    for (const index of this.cleaned.keys()) {
      if (index >= first * width && index < (first + count) * width) this.cleaned.delete(index);
    }
    this.showDecisions([first, first + count - 1]);
  }

  // Shows what follows from the decisions, in some frames or in all: rejected and kept samples are as they were measured.
  showDecisions([from, to] = [0, this.frameCount - 1]) {
    const width = this.counts.after;
    for (const [index, [x, y, z, sd, state]] of this.cleaned) {
      if (index < from * width || index >= (to + 1) * width) continue;
      this.after.set([x, y, z], index * 3);
      [this.sd[index], this.state[index]] = [sd, state];
      this.cleaned.delete(index);
      this.requested.delete(index);
    }
    for (const correction of this.take.corrections) this.showRequested(correction, from, to);
    for (const change of this.take.changes) {
      if (change.decision === "accept" || SHIFT_KINDS.includes(change.kind)) continue;
      const first = Math.max(change.first - this.take.first_frame, from), last = Math.min(change.last - this.take.first_frame, to);
      for (const m of change.markers.map((label) => this.columns.get(label)).filter((each) => each !== undefined)) {
        for (let t = first; t <= last; t++) this.showDeclined(t * width + m, change);
      }
    }
  }

  // Notes the samples of a correction that requests a fill; they are shown once it is among the corrections.
  request(correction, marker, samples, name) { this.fills.set(describeFill(correction), { marker, samples, name }); }

  showRequested(correction, from, to) {
    const fill = this.fills.get(describeFill(correction)), first = correction.first - this.take.first_frame;
    for (let t = Math.max(first, from); fill && t <= Math.min(correction.last - this.take.first_frame, to); t++) {
      const index = t * this.counts.after + fill.marker, sample = fill.samples[t - first] ?? null, state = this.state[index];
      if (![STATE.filled, STATE.replaced, STATE.empty, STATE.suspect].includes(state) && !sample) continue;  // it is measured
      this.keepCleaned(index);
      this.after.set(sample?.slice(0, 3) ?? [NaN, NaN, NaN], index * 3);
      this.sd[index] = sample?.[3] ?? NaN;
      this.state[index] = !sample ? STATE.empty : Number.isNaN(this.before[index * 3]) ? STATE.filled : STATE.replaced;
      this.requested.set(index, fill.name);
    }
  }

  keepCleaned(index) {
    if (!this.cleaned.has(index)) this.cleaned.set(index, [...this.after.subarray(index * 3, index * 3 + 3), this.sd[index], this.state[index]]);
  }

  showDeclined(index, change) {
    const { before, after, sd, state } = this, isGap = change.before.missing > change.last - change.first;
    const wasMissing = Number.isNaN(before[index * 3]);
    if (!isGap && wasMissing && state[index] !== STATE.relabelled) return;  // this sample belongs to a gap
    this.keepCleaned(index);
    after.set(isGap ? [NaN, NaN, NaN] : before.subarray(index * 3, index * 3 + 3), index * 3);
    sd[index] = NaN;
    if (change.decision === "reject" && (isGap || !wasMissing)) state[index] = STATE.rejected;
    else state[index] = isGap || wasMissing ? STATE.empty : STATE.measured;
  }

  // Position of a trajectory in a layer as [x, y, z], NaN where missing.
  getPosition(layer, frame, index) {
    const start = (frame * this.counts[layer] + index) * 3;
    return [this[layer][start], this[layer][start + 1], this[layer][start + 2]];
  }
}

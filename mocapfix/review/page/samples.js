// The samples of a take, loaded in blocks: positions before and after cleaning, joints, uncertainty and state.
// What follows from the decisions is shown at once: `after`, `sd` and `state` are as they will be once the take is cleaned again.

import { fetchSamples, fetchTrace } from "./api.js";

const BLOCK_FRAMES = 600;
const SHIFT_KINDS = ["moved", "drift"];  // no sample differs

export const STATE = { measured: 0, filled: 1, replaced: 2, relabelled: 3, reassigned: 4, suspect: 5, empty: 6, rejected: 7 };

const NO_POSITION = [NaN, NaN, NaN];
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
    this.fills = new Map();  // of corrections that request a fill, by their content: [marker, [x, y, z, sd] of each frame, method], null until it is known
    this.traces = new Map();  // by marker: where the body has it (three coordinates a frame), or the angles of its joint (before and after)
    this.others = [];  // samples of the other people of the file, with which labels are exchanged
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
    const all = [this, ...this.others].sort((one, other) => (one.take.subject < other.take.subject ? -1 : 1)), changes = all.flatMap(({ take }) => take.changes);
    for (const each of all) each.showCleaned(from, to);
    this.showSwaps(all.flatMap(({ take }) => take.corrections).filter(({ kind, prevented }) => kind === "swap" && !prevented), from, to);
    for (const each of all) each.showOwnDecisions(changes, from, to);
  }

  // Exchanges labels as the next cleaning does, those of two people first, in the order of the subjects' names and of their files, where a swap is pending: of what was measured; what it fills is not known yet.
  showSwaps(swaps, from, to) {
    const locate = (label) => [this, ...this.others].map((samples) => ({ samples, index: samples.columns.get(label) })).find(({ index }) => index !== undefined);
    const located = swaps.map((each) => ({ ...each, places: each.markers.map(locate), first: Math.max(each.first - this.take.first_frame, from), last: Math.min(each.last - this.take.first_frame, to) }))
      .filter(({ places }) => places.every(Boolean));
    const ordered = [...located.filter(({ places: [one, other] }) => one.samples !== other.samples), ...located.filter(({ places: [one, other] }) => one.samples === other.samples)];
    const visit = (act) => ordered.forEach(({ places, markers, first, last }) => {
      const pending = located.filter((each) => each.is_pending && each.markers.some((label) => markers.includes(label)));
      for (let t = first; t <= last; t++) if (pending.some((each) => each.first <= t && t <= each.last)) act(places, t);
    });
    const read = ({ samples, index }, t, layer) => samples.getPosition(layer, t, index);
    visit((places, t) => { for (const each of places) each.samples.showMeasured(t * each.samples.counts.after + each.index, read(each, t, "before")); });
    visit((places, t) => {
      const positions = places.map((each) => read(each, t, "after")).reverse();
      places.forEach(({ samples, index }, n) => samples.showMeasured(t * samples.counts.after + index, positions[n]));
    });
  }

  showMeasured(index, position) {
    this.keepCleaned(index);
    this.after.set(position, index * 3);
    this.sd[index] = NaN;
    this.state[index] = Number.isNaN(position[0]) ? STATE.empty : position[0] === this.before[index * 3] ? STATE.measured : STATE.relabelled;
  }

  showCleaned(from, to) {
    const width = this.counts.after;
    for (const [index, [x, y, z, sd, state]] of this.cleaned) {
      if (index < from * width || index >= (to + 1) * width) continue;
      this.after.set([x, y, z], index * 3);
      [this.sd[index], this.state[index]] = [sd, state];
      this.cleaned.delete(index);
      this.requested.delete(index);
    }
  }

  showOwnDecisions(changes, from, to) {
    const width = this.counts.after;
    for (const correction of this.take.corrections) this.showRequested(correction, from, to);
    for (const change of changes) {
      if (change.decision === "accept" || SHIFT_KINDS.includes(change.kind)) continue;
      const first = Math.max(change.first - this.take.first_frame, from), last = Math.min(change.last - this.take.first_frame, to);
      for (const m of change.markers.map((label) => this.columns.get(label)).filter((each) => each !== undefined)) {
        for (let t = first; t <= last; t++) this.showDeclined(t * width + m, change);
      }
    }
  }

  // Returns whether the samples of a correction are neither known nor asked for; they are to be asked for then.
  claim(correction) { return !this.fills.has(describeFill(correction)) && Boolean(this.fills.set(describeFill(correction), null)); }

  // Notes the samples of a correction that requests a fill; they are shown once it is among the corrections.
  request(correction, marker, samples, name) { this.fills.set(describeFill(correction), { marker, samples, name }); }

  showRequested(correction, from, to) {
    const first = correction.first - this.take.first_frame;
    const fill = correction.kind === "keys" && correction.is_pending ? this.evaluateKeys(correction) : this.fills.get(describeFill(correction));
    for (let t = Math.max(first, from); fill && t <= Math.min(correction.last - this.take.first_frame, to); t++) {
      const index = t * this.counts.after + fill.marker, sample = fill.samples[t - first] ?? null, state = this.state[index];
      if (![STATE.filled, STATE.replaced, STATE.empty, STATE.suspect].includes(state) && !sample) continue;  // it is measured
      this.keepCleaned(index);
      this.after.set(sample?.slice(0, 3) ?? NO_POSITION, index * 3);
      this.sd[index] = sample?.[3] ?? NaN;
      this.state[index] = !sample ? STATE.empty : Number.isNaN(this.before[index * 3]) ? STATE.filled : STATE.replaced;
      this.requested.set(index, fill.name);
    }
  }

  evaluateKeys({ markers, first, last, points }) {
    const start = this.take.first_frame, marker = this.columns.get(markers[0]);
    const values = buildSpline(this, marker, points.map(([t, ...at]) => [t - start, at.map((each) => each / 1000)]), [first - start, last - start]);
    const samples = Array.from({ length: last - first + 1 }, (_, n) => (Number.isNaN(values[n * 3]) ? null : [...values.subarray(n * 3, n * 3 + 3)]));
    return { marker, samples, name: "set by hand" };
  }

  keepCleaned(index) {
    if (!this.cleaned.has(index)) this.cleaned.set(index, [...this.after.subarray(index * 3, index * 3 + 3), this.sd[index], this.state[index]]);
  }

  showDeclined(index, change) {
    const { before, after, sd, state } = this, isGap = change.before.missing > change.last - change.first;
    const wasMissing = Number.isNaN(before[index * 3]);
    if (!isGap && wasMissing && state[index] !== STATE.relabelled) return;  // this sample belongs to a gap
    this.keepCleaned(index);
    after.set(isGap ? NO_POSITION : before.subarray(index * 3, index * 3 + 3), index * 3);
    sd[index] = NaN;
    if (change.decision === "reject" && (isGap || !wasMissing)) state[index] = STATE.rejected;
    else state[index] = isGap || wasMissing ? STATE.empty : STATE.measured;
  }

  // Loads the trace of a marker; resolves to whether it is new.
  async loadTrace(m) {
    if (this.traces.has(m)) return false;
    this.traces.set(m, null);
    return Boolean(this.traces.set(m, new Float32Array(await fetchTrace(this.id, this.take.labels[m]))));
  }

  // Position of a trajectory in a layer as [x, y, z], NaN where missing.
  getPosition(layer, frame, index) {
    const start = (frame * this.counts[layer] + index) * 3;
    return [this[layer][start], this[layer][start + 1], this[layer][start + 2]];
  }
}

// Returns the spline through points [frame, [x, y, z]] of a marker and the samples beside the frames, as the next cleaning sets
// it (fill/gap_filling.py): three coordinates for each frame, NaN where it is not known.
export function buildSpline(samples, marker, points, [first, last]) {
  const values = new Float32Array(Math.max(0, last - first + 1 || 0) * 3).fill(NaN);
  const isShown = (t) => t >= 0 && t < samples.frameCount && !Number.isNaN(samples.getPosition("after", t, marker)[0]);
  const beside = [first - 2, first - 1, last + 1, last + 2].filter(isShown).map((t) => [t, samples.getPosition("after", t, marker)]);
  const knots = [...points, ...beside].sort(([one], [other]) => one - other);
  const slopes = knots.map((_, n) => {
    const [[from, a], [to, b]] = [knots[Math.max(n - 1, 0)], knots[Math.min(n + 1, knots.length - 1)]];
    return a.map((each, axis) => (b[axis] - each) / Math.max(to - from, 1));
  });
  for (let t = first, n = 0; t <= last; t++) {
    while (n < knots.length - 2 && knots[n + 1][0] <= t) n++;
    if (knots.length < 2 || t < knots[n][0] || t > knots[n + 1][0]) continue;
    const [[from, a], [to, b]] = [knots[n], knots[n + 1]], span = to - from, u = (t - from) / span;
    const weights = [2 * u ** 3 - 3 * u ** 2 + 1, u ** 3 - 2 * u ** 2 + u, 3 * u ** 2 - 2 * u ** 3, u ** 3 - u ** 2];
    values.set(a.map((each, axis) => weights[0] * each + weights[1] * span * slopes[n][axis] + weights[2] * b[axis] + weights[3] * span * slopes[n + 1][axis]), (t - first) * 3);
  }
  return values;
}

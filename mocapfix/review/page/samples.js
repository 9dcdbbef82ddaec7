// The samples of a take, loaded in blocks: positions before and after cleaning, joints, uncertainty and state.

import { fetchSamples } from "./api.js";

const BLOCK_FRAMES = 600;

export const STATE = { measured: 0, filled: 1, replaced: 2, relabelled: 3, reassigned: 4, suspect: 5, empty: 6 };

export class Samples {
  constructor(take) {
    this.id = take.id;
    this.frameCount = take.frame_count;
    this.counts = { before: take.labels.length, after: take.labels.length, unlabelled: take.unlabelled.length, joints: take.joints.length };
    for (const name of ["before", "after", "unlabelled", "joints"]) {
      this[name] = new Float32Array(this.frameCount * this.counts[name] * 3).fill(NaN);
    }
    this.sd = new Float32Array(this.frameCount * this.counts.after).fill(NaN);
    this.state = new Uint8Array(this.frameCount * this.counts.after).fill(STATE.empty);
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
  }

  // Position of a trajectory in a layer as [x, y, z], NaN where missing.
  getPosition(layer, frame, index) {
    const start = (frame * this.counts[layer] + index) * 3;
    return [this[layer][start], this[layer][start + 1], this[layer][start + 2]];
  }
}

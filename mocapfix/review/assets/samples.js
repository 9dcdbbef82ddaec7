/** The samples of a take, which arrive in blocks. */

import { getSamples } from "./api.js";

const BLOCK_FRAMES = 600;
export const FILLED = 1, REPLACED = 2, RELABELLED = 3, REASSIGNED = 4, SUSPECT = 5, EMPTY = 6;

export class Samples {
  constructor(take) {
    this.takeId = take.id;
    this.frameCount = take.frame_count;
    this.markerCount = take.labels.length;
    this.trajectoryCount = take.unlabelled.length;
    this.jointCount = take.joints.length;
    const allocate = (columns) => new Float32Array(this.frameCount * columns).fill(NaN);
    this.before = allocate(3 * this.markerCount);
    this.after = allocate(3 * this.markerCount);
    this.unlabelled = allocate(3 * this.trajectoryCount);
    this.joints = allocate(3 * this.jointCount);
    this.sd = allocate(this.markerCount);
    this.states = new Uint8Array(this.frameCount * this.markerCount).fill(EMPTY);
    this.isLoaded = new Array(Math.ceil(this.frameCount / BLOCK_FRAMES)).fill(false);
    this.isStopped = false;
  }

  hasFrame(frame) {
    return Boolean(this.isLoaded[Math.floor(frame / BLOCK_FRAMES)]);
  }

  /** Load all blocks, always the one around the current frame first; `receive(first, last)` is called after each. */
  async load(getFrame, receive) {
    for (let block = this.chooseBlock(getFrame()); block >= 0; block = this.chooseBlock(getFrame())) {
      const first = block * BLOCK_FRAMES, count = Math.min(BLOCK_FRAMES, this.frameCount - first);
      const buffer = await getSamples(this.takeId, first, count);
      if (this.isStopped) return;
      this.store(buffer, first, count);
      this.isLoaded[block] = true;
      receive(first, first + count - 1);
    }
  }

  chooseBlock(frame) {
    const current = Math.floor(frame / BLOCK_FRAMES);
    if (this.isLoaded[current] === false) return current;
    if (this.isLoaded[current + 1] === false) return current + 1;
    return this.isLoaded.indexOf(false);
  }

  store(buffer, first, count) {
    let offset = 0;
    for (const [array, columns] of [[this.before, 3 * this.markerCount], [this.after, 3 * this.markerCount],
      [this.unlabelled, 3 * this.trajectoryCount], [this.joints, 3 * this.jointCount], [this.sd, this.markerCount]]) {
      array.set(new Float32Array(buffer, offset, count * columns), first * columns);
      offset += 4 * count * columns;
    }
    this.states.set(new Uint8Array(buffer, offset, count * this.markerCount), first * this.markerCount);
  }

  isBeforeFaulty(frame, marker) {
    const state = this.states[frame * this.markerCount + marker];
    return state === REPLACED || state === SUSPECT;
  }

  isBeforeMoved(frame, marker) {
    const state = this.states[frame * this.markerCount + marker];
    return state === RELABELLED || state === REASSIGNED || state === FILLED;
  }

  isEstimated(frame, marker) {
    const state = this.states[frame * this.markerCount + marker];
    return state === FILLED || state === REPLACED;
  }

  isRelabelled(frame, marker) {
    return this.states[frame * this.markerCount + marker] === RELABELLED;
  }
}

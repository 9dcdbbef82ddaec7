// Playing a take: the current frame, its speed, and the slider.

const find = (id) => document.getElementById(id);

export class Playback {
  constructor({ onFrame }) {
    Object.assign(this, { onFrame, frame: 0, isPlaying: false, speed: 1, take: null, frameTimes: [] });
    find("speed").addEventListener("change", (event) => { this.speed = Number(event.target.value); });
    find("scrub").addEventListener("input", (event) => this.moveTo(Number(event.target.value)));
    find("frame").addEventListener("change", (event) => this.moveTo(Number(event.target.value) - this.take.first_frame));
  }

  setTake(take) {
    this.take = take;
    find("scrub").max = take.frame_count - 1;
    Object.assign(find("frame"), { min: take.first_frame, max: take.first_frame + take.frame_count - 1 });
  }

  moveTo(frame) {
    if (!this.take || !Number.isFinite(frame)) return;
    this.position = this.frame = Math.min(Math.max(Math.round(frame), 0), this.take.frame_count - 1);
    this.show();
  }

  show() {
    find("scrub").value = this.frame;
    if (document.activeElement !== find("frame")) find("frame").value = this.take.first_frame + this.frame;
    find("time").textContent = `${(this.frame / this.take.rate).toFixed(2)} s`;
    this.onFrame(this.frame);
  }

  toggle(isPlaying = !this.isPlaying) {
    if (!this.take) return;
    if (isPlaying && this.frame >= this.take.frame_count - 1) this.moveTo(0);
    this.isPlaying = isPlaying;
    this.lastTime = null;
    this.position = this.frame;
    find("play").textContent = isPlaying ? "⏸" : "▶";
  }

  changeSpeed(steps) {
    const select = find("speed");
    select.selectedIndex = Math.min(Math.max(select.selectedIndex + steps, 0), select.options.length - 1);
    this.speed = Number(select.value);
  }

  // Goes on to the frame of this moment, in milliseconds. Called once for each picture.
  advance(time) {
    if (!this.isPlaying) return;
    this.frameTimes = [...this.frameTimes.filter((each) => time - each < 1000), time];
    if (this.lastTime !== null && this.lastTime !== undefined) {
      this.position += ((time - this.lastTime) / 1000) * this.speed * this.take.rate;
      const frame = Math.floor(this.position);
      if (frame >= this.take.frame_count - 1) {
        this.toggle(false);
        this.moveTo(this.take.frame_count - 1);
        return;
      }
      if (frame !== this.frame) {
        this.frame = frame;
        this.show();
      }
    }
    this.lastTime = time;
  }

  // Pictures in the last second while playing.
  get frameRate() { return this.frameTimes.length; }
}

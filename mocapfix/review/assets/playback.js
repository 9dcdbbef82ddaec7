/** Playback by time, and its bar. */

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
const RATE_WINDOW_MS = 1000;

export class Playback {
  constructor(show) {
    this.show = show;
    this.isPlaying = false;
    this.speed = 1;
    this.frame = 0;
    this.frameCount = 1;
    this.rate = 60;
    this.drawnAt = [];
    this.measuredRate = 0;
  }

  setTake(take, frame) {
    this.pause();
    this.frameCount = take.frame_count;
    this.rate = take.rate;
    this.frame = Math.min(Math.max(frame, 0), take.frame_count - 1);
  }

  play() {
    if (this.frame >= this.frameCount - 1) this.frame = 0;
    this.isPlaying = true;
    this.drawnAt = [];
    this.restart();
  }

  pause() {
    this.isPlaying = false;
  }

  restart() {
    this.startFrame = this.frame;
    this.startTime = performance.now();
  }

  seek(frame) {
    this.frame = Math.min(Math.max(Math.round(frame), 0), this.frameCount - 1);
    this.restart();
    this.show();
  }

  changeSpeed(step) {
    this.setSpeed(SPEEDS[Math.min(Math.max(SPEEDS.indexOf(this.speed) + step, 0), SPEEDS.length - 1)]);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.restart();
  }

  /** Go to the frame of a time while playing; whether it is another frame. */
  advance(now) {
    if (!this.isPlaying) return false;
    const frame = this.startFrame + Math.floor(Math.max(0, now - this.startTime) / 1000 * this.rate * this.speed);
    if (frame >= this.frameCount - 1) this.pause();
    const next = Math.min(frame, this.frameCount - 1), isOther = next !== this.frame;
    this.frame = next;
    return isOther;
  }

  /** Count a drawn frame while playing; the time since the one before. */
  countFrame(now) {
    const before = this.drawnAt.at(-1) ?? now;
    this.drawnAt.push(now);
    while (this.drawnAt[0] < now - RATE_WINDOW_MS) this.drawnAt.shift();
    const duration = now - this.drawnAt[0];
    if (duration > 0) this.measuredRate = 1000 * (this.drawnAt.length - 1) / duration;
    return now - before;
  }
}

/** The elements of the bar. */
export class PlaybackBar {
  constructor(playback, find) {
    this.playback = playback;
    this.play = find("play");
    this.speed = find("speed");
    this.number = find("frame");
    this.scrub = find("scrub");
    this.marks = find("scrub-marks");
    this.time = find("time");
    this.speed.addEventListener("change", () => {
      playback.setSpeed(Number(this.speed.value));
      this.speed.blur();
    });
    this.scrub.addEventListener("input", () => playback.seek(Number(this.scrub.value)));
    this.number.addEventListener("change", () => {
      if (this.number.value !== "") playback.seek(Number(this.number.value) - this.firstFrame);
    });
    this.number.addEventListener("keydown", (event) => {
      if (event.key === "Enter") this.number.blur();
    });
    new ResizeObserver(() => this.drawMarks()).observe(this.marks);
  }

  setTake(take) {
    this.firstFrame = take.first_frame;
    this.lastFrame = take.first_frame + take.frame_count - 1;
    this.number.min = this.firstFrame;
    this.number.max = this.lastFrame;
    this.scrub.max = take.frame_count - 1;
  }

  update() {
    const { frame, rate, isPlaying, speed, frameCount } = this.playback;
    const label = isPlaying ? "Pause" : "Play";
    if (this.play.textContent !== label) this.play.textContent = label;
    if (this.speed.value !== String(speed)) this.speed.value = String(speed);
    if (document.activeElement !== this.number || isPlaying) this.number.value = frame + this.firstFrame;
    this.scrub.value = frame;
    this.time.textContent = `${(frame / rate).toFixed(2)} / ${((frameCount - 1) / rate).toFixed(2)} s`;
  }

  /** Draw where the changes are, in the colours of their decisions; the selected one last. */
  drawMarks(changes = this.changes, selected = this.selected) {
    Object.assign(this, { changes, selected });
    const { marks } = this, width = marks.clientWidth, height = marks.clientHeight;
    if (!changes || !width) return;
    marks.width = width;
    marks.height = height;
    const context = marks.getContext("2d"), style = getComputedStyle(document.documentElement);
    const scale = width / Math.max(1, this.lastFrame - this.firstFrame + 1);
    const color = (name) => style.getPropertyValue(`--${name}`).trim();
    const colors = { open: color("open"), accept: color("accept"), reject: color("reject"), keep: color("keep") };
    const place = (change) => [(change.first - this.firstFrame) * scale, Math.max(2, (change.last - change.first + 1) * scale)];
    const ordered = [...changes].sort((one, other) => Number(one.is_reviewed) - Number(other.is_reviewed));
    for (const change of ordered) {
      const [x, length] = place(change);
      context.fillStyle = colors[change.is_reviewed ? change.decision : "open"];
      context.fillRect(x, 3, length, height - 6);
    }
    const change = changes.find((each) => each.id === selected);
    if (!change) return;
    const [x, length] = place(change);
    context.strokeStyle = color("text");
    context.strokeRect(x - 0.5, 0.5, length + 1, height - 1);
  }
}

// The x, y and z curves of a marker before and after cleaning, with the uncertainty of what was estimated.

import { STATE } from "./samples.js";

const AXES = ["x", "y", "z"];
const CONTEXT_S = 1;
const MAX_POINTS = 2000;
const LEFT = 52, RIGHT = 8, TOP = 18, GAP = 6, BOTTOM = 14;
const BAND_SDS = 2;

export class CurveView {
  constructor(canvas, title, cursor, { onScrub, onStretch }) {
    Object.assign(this, { canvas, title, cursor, onScrub, onStretch, marker: null, interval: null, stretch: null, frame: 0 });
    this.drag = null;
    canvas.addEventListener("pointerdown", (event) => this.startDrag(event));
    canvas.addEventListener("pointermove", (event) => this.continueDrag(event));
    canvas.addEventListener("pointerup", () => { this.drag = null; });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  setTake(take, samples) {
    Object.assign(this, { take, samples, marker: null, interval: null, stretch: null });
  }

  // Shows a marker around an interval of frame indices.
  showMarker(marker, interval) {
    this.marker = marker;
    this.interval = interval;
    this.chooseWindow();
    this.draw();
  }

  chooseWindow() {
    const context = Math.round(CONTEXT_S * this.take.rate), last = this.take.frame_count - 1;
    const [from, to] = this.interval ?? [this.frame, this.frame];
    this.first = Math.max(0, from - context);
    this.last = Math.min(last, Math.max(to + context, this.first + 10));
  }

  setFrame(frame) {
    this.frame = frame;
    if (this.marker === null) return;
    if (frame < this.first || frame > this.last) {
      const half = Math.round((this.last - this.first) / 2);
      this.first = Math.max(0, frame - half);
      this.last = Math.min(this.take.frame_count - 1, this.first + 2 * half);
      this.draw();
    }
    this.placeCursor();
  }

  placeCursor() {
    this.cursor.hidden = this.marker === null;
    const share = (this.frame - this.first) / Math.max(1, this.last - this.first);
    this.cursor.style.transform = `translateX(${LEFT + share * (this.canvas.clientWidth - LEFT - RIGHT) - 1}px)`;
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.draw();
  }

  frameAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const share = (event.clientX - box.left - LEFT) / Math.max(1, box.width - LEFT - RIGHT);
    const frame = Math.round(this.first + share * (this.last - this.first));
    return Math.min(Math.max(frame, 0), this.take.frame_count - 1);
  }

  startDrag(event) {
    if (this.marker === null) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { isStretch: event.shiftKey, from: this.frameAt(event) };
    if (!event.shiftKey) this.onScrub(this.drag.from);
  }

  continueDrag(event) {
    if (!this.drag) return;
    const frame = this.frameAt(event);
    if (this.drag.isStretch) this.onStretch([Math.min(this.drag.from, frame), Math.max(this.drag.from, frame)]);
    else this.onScrub(frame);
  }

  draw() {
    const { canvas } = this, context = canvas.getContext("2d"), ratio = Math.min(window.devicePixelRatio, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    context.scale(ratio, ratio);
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    if (this.marker === null || !this.samples) {
      this.title.textContent = "";
      return;
    }
    const label = this.marker < this.take.labels.length ? this.take.labels[this.marker] : "";
    this.title.textContent = `${label}: x, y (up), z in mm; red before, green after, band of two standard deviations. Shift-drag or [ ] selects a stretch.`;
    const plot = { x: (t) => LEFT + ((t - this.first) / Math.max(1, this.last - this.first)) * (width - LEFT - RIGHT) };
    const rowHeight = (height - TOP - BOTTOM - 2 * GAP) / 3;
    this.shade(context, plot, this.interval, colour("--selected"), height);
    this.shade(context, plot, this.stretch, "rgba(224, 160, 48, 0.35)", height);
    context.font = "10px system-ui, sans-serif";
    AXES.forEach((axis, n) => this.drawAxis(context, { ...plot, axis: n, name: axis, top: TOP + n * (rowHeight + GAP), height: rowHeight }, colour));
    context.fillStyle = colour("--muted");
    context.fillText(String(this.take.first_frame + this.first), LEFT, height - 3);
    const lastText = String(this.take.first_frame + this.last);
    context.fillText(lastText, width - RIGHT - context.measureText(lastText).width, height - 3);
    this.placeCursor();
  }

  shade(context, plot, interval, fill, height) {
    if (!interval || interval[1] < this.first || interval[0] > this.last) return;
    const from = plot.x(Math.max(interval[0], this.first)), to = plot.x(Math.min(interval[1], this.last));
    context.fillStyle = fill;
    context.fillRect(from - 1, TOP, Math.max(2, to - from + 2), height - TOP - BOTTOM);
  }

  drawAxis(context, plot, colour) {
    const step = Math.max(1, Math.ceil((this.last - this.first) / MAX_POINTS)), { samples, marker } = this;
    const at = (name, t) => samples[name][(t * samples.counts.after + marker) * 3 + plot.axis] * 1000;
    let low = Infinity, high = -Infinity;
    const band = (t) => { const sd = samples.sd[t * samples.counts.after + marker]; return Number.isNaN(sd) ? 0 : BAND_SDS * sd * 1000; };
    for (let t = this.first; t <= this.last; t += step) {
      for (const value of [at("before", t), at("after", t) - band(t), at("after", t) + band(t)]) if (!Number.isNaN(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (low > high) [low, high] = [0, 1];
    const margin = Math.max(1, 0.06 * (high - low));
    [low, high] = [low - margin, high + margin];
    const y = (value) => plot.top + (1 - (value - low) / (high - low)) * plot.height;
    context.strokeStyle = colour("--line");
    context.strokeRect(LEFT, plot.top, plot.x(this.last) - LEFT, plot.height);
    context.fillStyle = colour("--muted");
    context.fillText(plot.name, 4, plot.top + plot.height / 2 + 3);
    context.textAlign = "right";
    context.fillText(high.toFixed(0), LEFT - 3, plot.top + 8);
    context.fillText(low.toFixed(0), LEFT - 3, plot.top + plot.height);
    context.textAlign = "left";
    context.save();
    context.beginPath();
    context.rect(LEFT, plot.top, plot.x(this.last) - LEFT, plot.height);
    context.clip();
    context.globalAlpha = 0.25;
    context.fillStyle = colour("--green");
    for (let t = this.first; t <= this.last; t += step) {
      const half = band(t), value = at("after", t);
      if (!half || Number.isNaN(value)) continue;
      const top = y(value + half), width = Math.max(1.5, plot.x(t + step) - plot.x(t));
      context.fillRect(plot.x(t) - width / 2, top, width, Math.max(1, y(value - half) - top));
    }
    context.globalAlpha = 1;
    this.drawPath(context, plot, step, (t) => y(at("before", t)), () => colour("--muted"), 1, colour("--red"));
    this.drawPath(context, plot, step, (t) => y(at("after", t)), () => colour("--green"), 1.3, colour("--green"));
    context.restore();
  }

  // Draws a curve; where the sample was changed it has the colour `changed`.
  drawPath(context, plot, step, y, plain, lineWidth, changed) {
    const { samples, marker } = this;
    context.lineWidth = lineWidth;
    for (const isChanged of [false, true]) {
      context.strokeStyle = isChanged ? changed : plain();
      context.beginPath();
      let isOpen = false;
      for (let t = this.first; t <= this.last; t += step) {
        const value = y(t), state = samples.state[t * samples.counts.after + marker];
        if (Number.isNaN(value) || (state !== STATE.measured) !== isChanged) { isOpen = false; continue; }
        if (isOpen) context.lineTo(plot.x(t), value);
        else { context.moveTo(plot.x(t) - 0.7, value); context.lineTo(plot.x(t), value); }
        isOpen = true;
      }
      context.stroke();
    }
  }
}

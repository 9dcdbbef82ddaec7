/** The x, y and z of a marker before and after cleaning. */

const AXES = ["x", "y", "z"], LEFT = 78, CONTEXT_S = 1, LEAST_RANGE_M = 0.004, OUTLIER_FACTOR = 4;

export class Curves {
  constructor(canvas, cursor, { seek, selectStretch }) {
    Object.assign(this, { canvas, cursor, seek, selectStretch });
    this.isStale = false;
    new ResizeObserver(() => this.redraw()).observe(canvas);
    canvas.addEventListener("pointerdown", (event) => this.beginDrag(event));
    canvas.addEventListener("pointermove", (event) => this.continueDrag(event));
    canvas.addEventListener("pointerup", () => { this.drag = null; });
    canvas.addEventListener("pointercancel", () => { this.drag = null; });
  }

  setTake(take, samples) {
    Object.assign(this, { take, samples, marker: -1, interval: [0, 0], window: [0, 1], stretch: null });
  }

  /** Show a marker around an interval of frames. */
  setContent(marker, interval, stretch) {
    const context = Math.round(CONTEXT_S * this.take.rate), last = this.take.frame_count - 1;
    const first = Math.max(0, interval[0] - context);
    Object.assign(this, { marker, interval, stretch, window: [first, Math.max(first + 1, Math.min(last, interval[1] + context))] });
    this.redraw();
  }

  /** Move the vertical line; pages on if the frame is outside. */
  showFrame(frame) {
    if (!this.samples) return;
    const [first, last] = this.window, length = last - first;
    if (frame < first || frame > last) {
      const start = Math.max(0, Math.min(frame - Math.round(length / 10), this.take.frame_count - 1 - length));
      this.window = [start, start + length];
      this.redraw();
    }
    this.cursor.style.transform = `translateX(${this.locate(frame)}px)`;
    this.frame = frame;
  }

  locate(frame) {
    const [first, last] = this.window;
    return LEFT + (frame - first) / Math.max(1, last - first) * (this.canvas.clientWidth - LEFT - 6);
  }

  findFrame(event) {
    const [first, last] = this.window, x = event.clientX - this.canvas.getBoundingClientRect().left;
    const frame = Math.round(first + (x - LEFT) / (this.canvas.clientWidth - LEFT - 6) * (last - first));
    return Math.min(Math.max(frame, first), last);
  }

  beginDrag(event) {
    if (!this.samples || event.button) return;
    const frame = this.findFrame(event);
    this.drag = { start: event.shiftKey ? frame : null };
    this.canvas.setPointerCapture(event.pointerId);
    if (!event.shiftKey) this.seek(frame);
  }

  continueDrag(event) {
    if (!this.drag) return;
    const frame = this.findFrame(event), { start } = this.drag;
    if (start === null) this.seek(frame);
    else this.selectStretch([Math.min(start, frame), Math.max(start, frame)]);
  }

  /** Draw at the next frame of the browser. */
  redraw() {
    if (this.isStale) return;
    this.isStale = true;
    requestAnimationFrame(() => {
      this.isStale = false;
      this.draw();
      if (this.frame !== undefined && this.samples) this.cursor.style.transform = `translateX(${this.locate(this.frame)}px)`;
    });
  }

  draw() {
    const { canvas, samples } = this, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!samples || !width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    context.scale(ratio, ratio);
    context.font = "11px system-ui, sans-serif";
    this.color = (name) => style.getPropertyValue(`--${name}`).trim();
    const timeHeight = 16, paneHeight = (height - timeHeight) / 3;
    this.shade(context, this.interval, this.color("shade"), height - timeHeight);
    if (this.stretch) this.shade(context, this.stretch, this.color("stretch"), height - timeHeight);
    this.drawTimes(context, height);
    if (this.marker < 0) return;
    AXES.forEach((_, axis) => this.drawAxis(context, axis, axis * paneHeight + 3, paneHeight - 6));
  }

  shade(context, [first, last], color, height) {
    const end = Math.max(this.locate(last + 0.5), this.locate(first - 0.5) + 2), start = Math.max(LEFT, this.locate(first - 0.5));
    context.fillStyle = color;
    if (end > start) context.fillRect(start, 0, Math.min(end, this.canvas.clientWidth) - start, height);
  }

  drawTimes(context, height) {
    const [first, last] = this.window, width = this.canvas.clientWidth - LEFT;
    const step = chooseStep((last - first) / Math.max(2, width / 90));
    context.fillStyle = this.color("muted");
    context.textAlign = "center";
    context.textBaseline = "bottom";
    const offset = this.take.first_frame;
    const begin = Math.ceil((first + offset) / step) * step;
    for (let number = begin; number <= last + offset; number += step) {
      const x = this.locate(number - offset);
      context.fillRect(x, height - 16, 1, 3);
      if (x > LEFT + 12 && x < LEFT + width - 18) context.fillText(String(number), x, height - 1);
    }
    context.textAlign = "left";
    context.fillText("frame", 4, height - 1);
  }

  drawAxis(context, axis, top, height) {
    const { samples, marker } = this, [first, last] = this.window;
    const range = this.findRange(axis);
    context.fillStyle = this.color("muted");
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillText(AXES[axis], 4, top + height / 2);
    context.fillStyle = this.color("line");
    context.fillRect(LEFT, top + height + 3, this.canvas.clientWidth - LEFT, 1);
    if (!range) return;
    const scale = height / (range[1] - range[0]), levelOf = (value) => top + height - (value - range[0]) * scale;
    context.fillStyle = this.color("muted");
    context.textAlign = "right";
    const [low, high] = [range[0] * 1000, range[1] * 1000], step = chooseStep((high - low) / 3);
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      const y = levelOf(value / 1000);
      if (y > top + 4 && y < top + height - 3) context.fillText(`${Math.round(value)} mm`, LEFT - 5, y);
      context.globalAlpha = 0.35;
      context.fillRect(LEFT, y, this.canvas.clientWidth - LEFT - 6, 0.5);
      context.globalAlpha = 1;
    }
    context.save();
    context.beginPath();
    context.rect(LEFT, top - 2, this.canvas.clientWidth - LEFT, height + 4);
    context.clip();
    const stride = Math.max(1, Math.floor((last - first) / (4 * this.canvas.clientWidth)));
    const at = (array, frame) => array[3 * (frame * samples.markerCount + marker) + axis];
    this.drawBand(context, at, levelOf, stride);
    const isFaulty = (frame) => samples.isBeforeFaulty(frame, marker);
    const isEstimated = (frame) => samples.isEstimated(frame, marker) || samples.isRelabelled(frame, marker);
    this.drawLine(context, samples.before, at, levelOf, stride, 2.5, (frame) => (isFaulty(frame) ? "scene-faulty" : "scene-before"));
    this.drawLine(context, samples.after, at, levelOf, stride, 1.5, (frame) => (isEstimated(frame) ? "scene-estimated" : "measured"));
    context.restore();
  }

  drawBand(context, at, levelOf, stride) {
    const { samples, marker } = this, [first, last] = this.window;
    context.fillStyle = this.color("band");
    const half = Math.max(1, (this.locate(first + stride) - this.locate(first)) / 2);
    for (let frame = first; frame <= last; frame += stride) {
      const value = at(samples.after, frame), sd = samples.sd[frame * samples.markerCount + marker];
      if (Number.isNaN(value) || Number.isNaN(sd)) continue;
      const upper = levelOf(value + 2 * sd), lower = levelOf(value - 2 * sd);
      context.fillRect(this.locate(frame) - half, upper, 2 * half, Math.max(1, lower - upper));
    }
  }

  /** Draw runs of samples of one colour; a sample alone is a dot. */
  drawLine(context, array, at, levelOf, stride, width, choose) {
    const [first, last] = this.window;
    context.lineWidth = width;
    let name = null, run = 0, x = 0, y = 0;
    const finish = () => {
      if (run === 1) {
        context.fillStyle = this.color(name);
        context.fillRect(x - width, y - width, 2 * width, 2 * width);
      } else if (run) context.stroke();
      run = 0;
    };
    for (let frame = first; frame <= last; frame += stride) {
      const value = at(array, frame);
      if (Number.isNaN(value)) {
        finish();
        continue;
      }
      const next = choose(frame), [lastX, lastY, wasDrawn] = [x, y, run > 0];
      [x, y] = [this.locate(frame), levelOf(value)];
      if (!wasDrawn || next !== name) {
        if (wasDrawn && run > 1) finish();
        run = wasDrawn ? 1 : 0;
        name = next;
        context.beginPath();
        context.strokeStyle = this.color(name);
        context.moveTo(wasDrawn ? lastX : x, wasDrawn ? lastY : y);
      }
      context.lineTo(x, y);
      run += 1;
    }
    finish();
  }

  /** The range of values of a pane in metres; samples before cleaning that lie far off are cut. */
  findRange(axis) {
    const { samples, marker } = this, [first, last] = this.window;
    let after = [Infinity, -Infinity], before = [Infinity, -Infinity];
    const widen = (range, low, high) => [Math.min(range[0], low), Math.max(range[1], high)];
    for (let frame = first; frame <= last; frame += 1) {
      const index = frame * samples.markerCount + marker, sd = samples.sd[index] || 0;
      const [a, b] = [samples.after[3 * index + axis], samples.before[3 * index + axis]];
      if (!Number.isNaN(a)) after = widen(after, a - 2 * sd, a + 2 * sd);
      if (!Number.isNaN(b)) before = widen(before, b, b);
    }
    let range = after[0] > after[1] ? before : after;
    if (range[0] > range[1]) return null;
    const reach = OUTLIER_FACTOR * Math.max(range[1] - range[0], LEAST_RANGE_M);
    range = widen(range, Math.max(before[0], range[0] - reach), Math.min(before[1], range[1] + reach));
    const margin = Math.max((range[1] - range[0]) * 0.06, (LEAST_RANGE_M - range[1] + range[0]) / 2);
    return [range[0] - margin, range[1] + margin];
  }
}

function chooseStep(rough) {
  const power = 10 ** Math.floor(Math.log10(Math.max(rough, 1)));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough) ?? 10 * power;
}

// Curves of markers over time, before and after cleaning, with the uncertainty of what was estimated.

import { STATE } from "./samples.js";
import { TimeWindow } from "./window.js";

const CONTEXT_S = 1;
const LEFT = 92, RIGHT = 14, TOP = 20, GAP = 6, BOTTOM = 14;
const BAND_SDS = 2;
const OTHER_COLOURS = ["#0072b2", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f"];  // of the markers beside the first
export const MAX_CURVE_MARKERS = 1 + OTHER_COLOURS.length;

// What can be shown: its rows, unit, and the value of a marker in a row and frame of a layer, NaN where it has none.
const axis = (n) => ({ samples }, layer, m, t) => samples[layer][(t * samples.counts[layer] + m) * 3 + n] * 1000;
const between = (samples, layer, one, t, other, s) => Math.hypot(...[0, 1, 2].map((n) => samples[layer][(t * samples.counts[layer] + one) * 3 + n]
  - samples[layer][(s * samples.counts[layer] + other) * 3 + n]));
const QUANTITIES = {
  position: { unit: "mm", rows: [["x", axis(0)], ["y up", axis(1)], ["z", axis(2)]], hasBand: true },
  speed: { unit: "m/s", rows: [["speed", ({ samples, take }, layer, m, t) => (t ? between(samples, layer, m, t, m, t - 1) * take.rate : NaN)]] },
  distance: { unit: "mm", rows: [["distance", ({ samples, reference }, layer, m, t) => between(samples, layer, m, t, reference, t) * 1000]] },
};

export class CurveView {
  constructor(canvas, { onScrub, onStretch }) {
    const find = (id) => document.getElementById(id);
    Object.assign(this, {
      canvas, title: find("curves-title"), cursor: find("curves-cursor"), quantity: find("curves-quantity"), other: find("curves-reference"),
      onScrub, onStretch, markers: [], interval: null, stretch: null, frame: 0, drag: null,
    });
    this.window = new TimeWindow(canvas, { left: LEFT, right: RIGHT, onChange: () => this.draw() });
    canvas.addEventListener("pointerdown", (event) => this.startDrag(event));
    canvas.addEventListener("pointermove", (event) => this.continueDrag(event));
    canvas.addEventListener("pointerup", () => { this.drag = null; });
    for (const select of [this.quantity, this.other]) select.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  setTake(take, samples) {
    Object.assign(this, { take, samples, markers: [], interval: null, stretch: null });
    this.other.replaceChildren(...take.labels.map((label, m) => new Option(label, m)));
    this.window.setCount(take.frame_count);
  }

  get marker() { return this.markers[0] ?? null; }
  get reference() { return Number(this.other.value); }

  // Shows markers around an interval of frame indices, the first of them with its state before and its uncertainty.
  showMarkers(markers, interval) {
    const context = Math.round(CONTEXT_S * this.take.rate);
    Object.assign(this, { markers: markers.slice(0, MAX_CURVE_MARKERS), interval });
    if (interval) this.window.show(interval[0] - context, interval[1] + context);
    else this.draw();
  }

  // Shows a marker beside those that are shown, or no longer.
  toggleMarker(marker) {
    this.markers = this.markers.includes(marker) ? this.markers.filter((each) => each !== marker) : [...this.markers, marker].slice(-MAX_CURVE_MARKERS);
    this.draw();
  }

  // Shows the next quantity.
  changeQuantity() {
    this.quantity.selectedIndex = (this.quantity.selectedIndex + 1) % this.quantity.options.length;
    this.draw();
  }

  setFrame(frame) {
    this.frame = frame;
    if (this.marker === null) return;
    this.window.reveal(frame);
    this.placeCursor();
  }

  placeCursor() {
    this.cursor.hidden = this.marker === null;
    this.cursor.style.transform = `translateX(${this.window.x(this.frame) - 1}px)`;
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.draw();
  }

  startDrag(event) {
    if (this.marker === null || event.button || event.altKey) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { isStretch: event.shiftKey, from: this.window.frameAt(event.clientX) };
    if (!event.shiftKey) this.onScrub(this.drag.from);
  }

  continueDrag(event) {
    if (!this.drag) return;
    const frame = this.window.frameAt(event.clientX);
    if (this.drag.isStretch) this.onStretch([Math.min(this.drag.from, frame), Math.max(this.drag.from, frame)]);
    else this.onScrub(frame);
  }

  draw() {
    const { canvas } = this, context = canvas.getContext("2d"), ratio = Math.min(window.devicePixelRatio, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight, quantity = QUANTITIES[this.quantity.value];
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    context.scale(ratio, ratio);
    this.other.hidden = this.quantity.value !== "distance";
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    this.title.replaceChildren();
    if (this.marker === null || !this.samples) return;
    this.title.append(...this.markers.map((m, n) => buildName(this.take.labels[m], n ? OTHER_COLOURS[n - 1] : colour("--green"))), quantity.unit);
    const rowHeight = (height - TOP - BOTTOM - GAP * (quantity.rows.length - 1)) / quantity.rows.length;
    this.shade(context, this.interval, colour("--selected"), height);
    this.shade(context, this.stretch, "rgba(224, 160, 48, 0.35)", height);
    context.font = "11px system-ui, sans-serif";
    quantity.rows.forEach(([name, evaluate], n) => {
      this.drawRow(context, { name, top: TOP + n * (rowHeight + GAP), height: rowHeight, hasBand: quantity.hasBand ?? false, value: (...args) => evaluate(this, ...args) }, colour);
    });
    context.fillStyle = colour("--muted");
    const [from, to] = [this.window.first, this.window.last].map((each) => String(Math.round(this.take.first_frame + each)));
    context.fillText(from, LEFT, height - 3);
    context.fillText(to, LEFT + this.window.width - context.measureText(to).width, height - 3);
    this.placeCursor();
  }

  shade(context, interval, fill, height) {
    if (!interval) return;
    const from = Math.max(this.window.x(interval[0]), LEFT), to = Math.min(this.window.x(interval[1]), LEFT + this.window.width);
    context.fillStyle = fill;
    if (to >= from) context.fillRect(from - 1, TOP, Math.max(2, to - from + 2), height - TOP - BOTTOM);
  }

  drawRow(context, row, colour) {
    const first = Math.max(0, Math.floor(this.window.first)), last = Math.min(this.take.frame_count - 1, Math.ceil(this.window.last));
    const { samples, marker } = this, width = samples.counts.after, lines = this.markers.map((m) => this.readLine(row, "after", m, first, last));
    const before = this.readLine(row, "before", marker, first, last), after = lines[0];
    const half = (t) => (row.hasBand && !Number.isNaN(samples.sd[t * width + marker]) ? BAND_SDS * samples.sd[t * width + marker] * 1000 : 0);
    let low = Infinity, high = -Infinity;
    for (const line of [before, ...lines]) for (const value of line) if (!Number.isNaN(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    for (let t = first; t <= last; t++) if (half(t) && !Number.isNaN(after[t - first])) [low, high] = [Math.min(low, after[t - first] - half(t)), Math.max(high, after[t - first] + half(t))];
    if (low > high) [low, high] = [0, 1];
    const margin = Math.max(row.hasBand ? 1 : 0.001, 0.06 * (high - low));
    [low, high] = [low - margin, high + margin];
    const y = (value) => row.top + (1 - (value - low) / (high - low)) * row.height, digits = high - low < 10 ? 2 : 0;
    context.strokeStyle = colour("--line");
    context.lineWidth = 1;
    context.strokeRect(LEFT, row.top, this.window.width, row.height);
    context.fillStyle = colour("--muted");
    context.fillText(row.name, 6, row.top + row.height / 2 + 3);
    context.textAlign = "right";
    context.fillText(high.toFixed(digits), LEFT - 4, row.top + 9);
    context.fillText(low.toFixed(digits), LEFT - 4, row.top + row.height);
    context.textAlign = "left";
    context.save();
    context.beginPath();
    context.rect(LEFT, row.top, this.window.width, row.height);
    context.clip();
    const state = (t) => samples.state[t * width + marker], isEstimated = (t) => half(t) > 0;
    context.fillStyle = `color-mix(in srgb, ${colour("--red")} 22%, transparent)`;
    this.fillRuns(context, first, last, (t) => state(t) === STATE.rejected, row);
    context.fillStyle = `color-mix(in srgb, ${colour("--green")} 25%, transparent)`;
    this.fillBand(context, first, last, isEstimated, (t) => [y(after[t - first] - half(t)), y(after[t - first] + half(t))]);
    const isChanged = (t) => state(t) !== STATE.measured;
    lines.slice(1).forEach((line, n) => this.strokeLine(context, line, first, y, () => true, OTHER_COLOURS[n], 1));
    this.strokeLine(context, before, first, y, (t) => !isChanged(t), colour("--muted"), 1.2);
    this.strokeLine(context, before, first, y, isChanged, colour("--red"), 1.2);
    this.strokeLine(context, after, first, y, (t) => state(t) !== STATE.rejected, colour("--green"), 1.4);
    context.restore();
  }

  readLine(row, layer, marker, first, last) {
    const line = new Float64Array(last - first + 1);
    for (let t = first; t <= last; t++) line[t - first] = row.value(layer, marker, t);
    return line;
  }

  // Draws the samples of a line that are chosen; where many fall on one pixel, their lowest and highest.
  strokeLine(context, line, first, y, isChosen, style, lineWidth) {
    context.strokeStyle = style;
    context.lineWidth = lineWidth;
    context.beginPath();
    let isOpen = false, column = -1, low = 0, high = 0;
    const close = () => { if (isOpen && high > low) { context.lineTo(column, y(low)); context.lineTo(column, y(high)); } };
    line.forEach((value, n) => {
      if (Number.isNaN(value) || !isChosen(n + first)) { close(); isOpen = false; return; }
      const x = this.window.x(n + first), place = Math.round(2 * x) / 2;
      if (isOpen && place === column) { [low, high] = [Math.min(low, value), Math.max(high, value)]; return; }
      close();
      if (isOpen) context.lineTo(x, y(value));
      else { context.moveTo(x - 0.7, y(value)); context.lineTo(x, y(value)); }
      [isOpen, column, low, high] = [true, place, value, value];
    });
    close();
    context.stroke();
  }

  // Fills the area between two limits over the runs of chosen frames; each run reaches the frames beside it.
  fillBand(context, first, last, isChosen, limits) {
    for (const [from, to] of findRuns(first, last, isChosen)) {
      const frames = Array.from({ length: to - from + 1 }, (_, n) => from + n);
      context.beginPath();
      for (const t of frames) context.lineTo(this.window.x(t), limits(t)[0]);
      for (const t of frames.reverse()) context.lineTo(this.window.x(t), limits(t)[1]);
      context.fill();
    }
  }

  fillRuns(context, first, last, isChosen, row) {
    for (const [from, to] of findRuns(first, last, isChosen)) {
      context.fillRect(this.window.x(from - 0.5), row.top, Math.max(1.5, this.window.x(to + 0.5) - this.window.x(from - 0.5)), row.height);
    }
  }
}

function findRuns(first, last, isChosen) {
  const runs = [];
  for (let t = first; t <= last; t++) {
    if (!isChosen(t)) continue;
    if (runs.length && runs.at(-1)[1] === t - 1) runs.at(-1)[1] = t;
    else runs.push([t, t]);
  }
  return runs;
}

function buildName(label, colour) {
  const name = document.createElement("b");
  name.textContent = label;
  name.style.color = colour;
  return name;
}

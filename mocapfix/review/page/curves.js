// Curves of markers over time, before and after cleaning, with the uncertainty of what was estimated.

import { STATE } from "./samples.js";
import { TimeWindow } from "./window.js";

const CONTEXT_S = 1;
const LEFT = 92, RIGHT = 14, TOP = 20, GAP = 6, BOTTOM = 14;
const BAND_SDS = 2;
const KEY_PX = 7;
const SCALE_FACTOR = 1.25;  // of the values, for each step of the wheel
const OTHER_COLOURS = ["#2a8fd0", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f"];  // of the markers beside the first
const MAX_CURVE_MARKERS = 1 + OTHER_COLOURS.length;

// What can be shown: its rows, unit, and the value of a marker in a row and frame of a layer, NaN where it has none.
const axis = (n) => ({ samples }, layer, m, t) => samples[layer][(t * samples.counts[layer] + m) * 3 + n] * 1000;
const between = (samples, layer, one, t, other, s) => {
  const values = samples[layer], a = (t * samples.counts[layer] + one) * 3, b = (s * samples.counts[layer] + other) * 3;
  return Math.hypot(values[a] - values[b], values[a + 1] - values[b + 1], values[a + 2] - values[b + 2]);
};
// Where the body has a marker, and the angles of a joint of an animation, are loaded for each marker when they are first shown.
const toBody = ({ samples }, layer, m, t) => {
  const at = (t * samples.counts[layer] + m) * 3, body = samples.traces?.get(m);
  return body ? Math.hypot(...[0, 1, 2].map((n) => samples[layer][at + n] - body[3 * t + n])) * 1000 : NaN;
};
const angle = (n) => ({ samples }, layer, m, t) => samples.traces?.get(m)?.[6 * t + n + (layer === "before" ? 0 : 3)] ?? NaN;
const QUANTITIES = {
  position: { unit: "mm", rows: [["x", axis(0)], ["y up", axis(1)], ["z", axis(2)]], hasBand: true, isSigned: true, hasEstimates: true },
  speed: { unit: "m/s", rows: [["speed", ({ samples, take }, layer, m, t) => (t ? between(samples, layer, m, t, m, t - 1) * take.rate : NaN)]], hasEstimates: true },
  distance: { unit: "mm", rows: [["distance", ({ samples, reference }, layer, m, t) => between(samples, layer, m, t, reference, t) * 1000]] },
  body: { unit: "mm", rows: [["to body", toBody]], isTraced: true },
  rotation: { unit: "°", rows: [["x", angle(0)], ["y", angle(1)], ["z", angle(2)]], isSigned: true, isTraced: true },
};

export class CurveView {
  constructor(canvas, { onScrub, onStretch, onKey, onRemoveKey, onError }) {
    const find = (id) => document.getElementById(id);
    Object.assign(this, {
      canvas, title: find("curves-title"), cursor: find("curves-cursor"), quantity: find("curves-quantity"), other: find("curves-reference"), band: find("curves-band"),
      onScrub, onStretch, onKey, onRemoveKey, onError, rows: [], markers: [], interval: null, stretch: null, frame: 0, drag: null, magnification: 1, estimates: [],
    });
    this.window = new TimeWindow(canvas, { left: LEFT, right: RIGHT, onChange: () => this.draw(), accepts: (event) => !event.ctrlKey });
    canvas.addEventListener("wheel", (event) => this.scale(event), { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.startDrag(event));
    canvas.addEventListener("pointermove", (event) => this.continueDrag(event));
    canvas.addEventListener("pointerup", () => this.endDrag());
    this.other.addEventListener("change", () => { this.isReferenceChosen = true; });
    for (const select of [this.quantity, this.other]) select.addEventListener("change", () => this.draw());
  }

  setTake(take, samples, names) {
    Object.assign(this, { take, samples, names, markers: [], interval: null, stretch: null, isReferenceChosen: false });
    this.other.replaceChildren(...take.labels.map((label, m) => new Option(label, m)));
    for (const option of this.quantity.options) option.hidden = option.disabled = { body: !take.can_correct || !take.joints.length, rotation: take.can_correct }[option.value] ?? false;
    if (this.quantity.selectedOptions[0].disabled) this.quantity.value = "position";
    this.window.setCount(take.frame_count);
  }

  get marker() { return this.markers[0] ?? null; }
  get reference() { return Number(this.other.value); }

  // Shows markers around an interval of frame indices, the first of them with its state before and its uncertainty.
  showMarkers(markers, interval) {
    const context = Math.round(CONTEXT_S * this.take.rate);
    Object.assign(this, { markers: markers.slice(0, MAX_CURVE_MARKERS), interval, magnification: 1 });
    if (markers.length && !this.isReferenceChosen) this.other.value = this.findNearest(markers[0]);
    if (interval) this.window.show(interval[0] - context, interval[1] + context);
    else this.draw();
  }

  // Enlarges the values with the wheel and Ctrl, up to those of the whole curve.
  scale(event) {
    if (!event.ctrlKey) return;
    event.preventDefault();
    this.magnification = Math.max(1, this.magnification * (event.deltaY > 0 ? 1 / SCALE_FACTOR : SCALE_FACTOR));
    this.draw();
  }

  // Shows a marker beside those that are shown, or no longer.
  toggleMarker(marker) {
    this.markers = this.markers.includes(marker) ? this.markers.filter((each) => each !== marker) : [...this.markers, marker].slice(-MAX_CURVE_MARKERS);
    this.draw();
  }

  // Shows the next quantity.
  changeQuantity() {
    const options = [...this.quantity.options].filter((each) => !each.disabled);
    this.quantity.value = options[(options.indexOf(this.quantity.selectedOptions[0]) + 1) % options.length].value;
    this.draw();
  }

  setFrame(frame) {
    this.frame = frame;
    if (this.marker === null) return;
    this.window.reveal(frame);
    if (this.magnification > 1) this.draw();
    else this.placeCursor();
  }

  placeCursor() {
    this.cursor.hidden = this.marker === null;
    this.cursor.style.transform = `translateX(${this.window.x(this.frame) - 1}px)`;
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.draw();
  }

  // Shows estimates of the first marker: thin lines with their numbers.
  setEstimates(estimates) {
    this.estimates = estimates;
    this.draw();
  }

  startDrag(event) {
    if (this.marker === null || event.button || event.altKey) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { isStretch: event.shiftKey, from: this.window.frameAt(event.clientX) };
    if (event.ctrlKey || event.metaKey) return this.startKey(event);
    if (!event.shiftKey) this.onScrub(this.drag.from);
  }

  // Begins to move the point under the pointer, or a new one.
  startKey(event) {
    const from = this.drag.from, at = event.clientY - this.canvas.getBoundingClientRect().top;
    const axis = this.rows.findIndex(({ top, height }) => at >= top && at <= top + height), { points } = this.estimates[0] ?? {};
    if (axis < 0 || this.quantity.value !== "position") { this.drag = null; return; }
    const near = [...points?.keys() ?? []].find((t) => Math.abs(this.window.x(t) - this.window.x(from)) < KEY_PX && Math.abs(this.rows[axis].y(points.get(t)[axis] * 1000) - at) < KEY_PX);
    Object.assign(this.drag, { axis, from: near ?? from, isKept: near !== undefined, row: this.rows[axis], y: at });
    if (near === undefined) this.onKey(from, axis, this.readValue(at));
  }

  // The value in metres at a height of the row that is dragged, whose scale stays meanwhile.
  readValue(at) {
    const { top, height, low, high } = this.drag.row;
    return (low + (1 - (at - top) / height) * (high - low)) / 1000;
  }

  endDrag() {
    if (this.drag?.isKept) this.onRemoveKey(this.drag.from);
    this.drag = null;
  }

  continueDrag(event) {
    if (!this.drag) return;
    if (this.drag.row) {
      const at = event.clientY - this.canvas.getBoundingClientRect().top;
      if (this.drag.isKept && Math.abs(at - this.drag.y) < 2) return;
      this.drag.isKept = false;
      return this.onKey(this.drag.from, this.drag.axis, this.readValue(at));
    }
    const frame = this.window.frameAt(event.clientX);
    if (this.drag.isStretch) this.onStretch([Math.min(this.drag.from, frame), Math.max(this.drag.from, frame)]);
    else this.onScrub(frame);
  }

  draw() {
    const { canvas } = this, context = canvas.getContext("2d", { willReadFrequently: true }), ratio = Math.min(window.devicePixelRatio, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight, quantity = QUANTITIES[this.quantity.value];
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    context.scale(ratio, ratio);
    this.other.hidden = this.quantity.value !== "distance";
    this.band.hidden = !quantity.hasBand;
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    this.title.replaceChildren();
    if (this.marker === null || !this.samples) return;
    this.title.append(...this.markers.map((m, n) => buildName(this.names[m], n ? OTHER_COLOURS[n - 1] : colour("--estimated"))), quantity.unit);
    if (quantity.isTraced) for (const m of this.markers) this.samples.loadTrace(m).then((isNew) => isNew && this.draw(), (error) => this.onError(error.message));
    if (quantity.isTraced && this.samples.traces.get(this.marker)?.length === 0) this.title.append(": not on the body");
    const rowHeight = (height - TOP - BOTTOM - GAP * (quantity.rows.length - 1)) / quantity.rows.length;
    if (!this.estimates.length) this.shade(context, this.interval, colour("--selected"), height);
    this.shade(context, this.stretch, "rgba(224, 160, 48, 0.35)", height);
    context.font = "11px system-ui, sans-serif";
    this.rows = [];
    quantity.rows.forEach(([name, evaluate], n) => {
      this.drawRow(context, { name, top: TOP + n * (rowHeight + GAP), height: rowHeight, hasBand: quantity.hasBand && !this.estimates.length, isSigned: quantity.isSigned ?? false, value: (...args) => evaluate(this, ...args), evaluate }, colour);
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
    const { marker, window: { first, last } } = this, scale = this.divideFrames(first, last), state = this.readStates(scale);
    const isAny = () => true, isChanged = (t) => (state[t - scale.from] ?? STATE.measured) !== STATE.measured, isShown = (t) => state[t - scale.from] !== STATE.rejected;
    const values = this.markers.map((m) => this.readValues(row, "after", m, scale)), before = this.readValues(row, "before", marker, scale);
    const others = values.slice(1).map((each) => reduce(each, scale, isAny)), after = reduce(values[0], scale, isShown);
    const plain = reduce(before, scale, (t) => !isChanged(t)), changed = reduce(before, scale, (t) => isChanged(t - 1) || isChanged(t) || isChanged(t + 1));  // joined to what is measured
    const band = row.hasBand ? this.readBand(values[0], scale) : null;
    const estimates = (QUANTITIES[this.quantity.value].hasEstimates ? this.estimates : []).map((each) => reduce(this.readEstimate(row, each, scale), scale, isAny));
    let [low, high] = findRange([plain, changed, after, ...others, ...estimates, ...(band ? [band] : [])]);
    const margin = Math.max(row.isSigned ? 1 : 0.001, 0.06 * (high - low));
    [low, high] = this.magnify(row.isSigned ? low - margin : Math.max(0, low - margin), high + margin, after);
    const y = (value) => row.top + (1 - (value - low) / (high - low)) * row.height, digits = high - low < 10 ? 2 : 0;
    this.rows.push({ ...row, low, high, y });
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
    context.fillStyle = `color-mix(in srgb, ${colour("--faulty")} 22%, transparent)`;
    this.fillRuns(context, scale, state, row);
    context.fillStyle = `color-mix(in srgb, ${colour("--estimated")} 25%, transparent)`;
    if (band) this.fillBand(context, band, y);
    others.forEach((line, n) => this.strokeLine(context, line, y, OTHER_COLOURS[n], 1));
    this.strokeLine(context, plain, y, colour("--before"), 1.2);
    this.strokeLine(context, changed, y, colour("--faulty"), 1.2);
    this.strokeLine(context, after, y, colour("--estimated"), 1.4);
    estimates.forEach((line, n) => this.drawEstimate(context, line, y, this.estimates[n], colour("--text")));
    context.restore();
  }

  // Returns the limits of the values, about the curve at the frame that is shown where they are enlarged.
  magnify(low, high, { from, step, low: values }) {
    const here = values[Math.floor((this.frame - from) / step)], half = (high - low) / 2 / this.magnification;
    const middle = this.magnification > 1 && Number.isFinite(here) ? here : (low + high) / 2;
    return [middle - half, middle + half];
  }

  // Returns the marker that is nearest to another in the frame that is shown, to which the distance is told at first.
  findNearest(marker) {
    const distances = this.take.labels.map((_, m) => (m === marker ? NaN : between(this.samples, "after", marker, this.frame, m, this.frame)));
    const known = distances.filter((each) => !Number.isNaN(each));
    return known.length ? distances.indexOf(Math.min(...known)) : 0;
  }

  // Returns the frames that are drawn, and how many of them are drawn at one place.
  divideFrames(first, last) {
    const step = Math.max(1, Math.floor((last - first) / this.window.width)), from = Math.max(0, Math.floor(Math.floor(first) / step) * step);
    const to = Math.min(this.take.frame_count - 1, Math.ceil(last));
    return { step, from, to, count: Math.floor((to - from) / step) + 1 };
  }

  readStates({ from, to }) {
    const { state, counts } = this.samples, states = new Uint8Array(to - from + 1);
    for (let t = from, at = from * counts.after + this.marker; t <= to; t++, at += counts.after) states[t - from] = state[at];
    return states;
  }

  readValues(row, layer, marker, { from, to }) {
    const values = new Float64Array(to - from + 1);
    for (let t = from; t <= to; t++) values[t - from] = row.value(layer, marker, t);
    return values;
  }

  readEstimate(row, { layer, from, length }, scale) {
    const { take } = this, value = (t) => (t >= 0 && t < length ? row.evaluate({ samples: layer, take }, "values", 0, t) : NaN);
    return Float64Array.from({ length: scale.to - scale.from + 1 }, (_, n) => value(n + scale.from - from));
  }

  drawEstimate(context, line, y, { colour, isActive, number, from, length, points }, textColour) {
    this.strokeLine(context, line, y, colour, isActive ? 3 : 1.3);
    if (points) return this.drawKeys(context, points, y, colour);
    const at = Math.floor((from + (length * number) / 8 - line.from) / line.step);
    if (!(line.low[at] <= line.high[at])) return;
    context.fillStyle = textColour;
    context.fillText(String(number), this.window.x(line.from + at * line.step), Math.max(y(line.high[at]) - 3, this.rows.at(-1).top + 9));  // within its row
  }

  // Draws the points of the row that was begun last.
  drawKeys(context, points, y, colour) {
    const axis = this.rows.length - 1;
    context.fillStyle = colour;
    for (const [t, at] of this.quantity.value === "position" ? points : []) context.fillRect(this.window.x(t) - 3.5, y(at[axis] * 1000) - 3.5, 7, 7);
  }

  // Returns the limits of the uncertainty of a line.
  readBand(values, scale) {
    const { sd, counts } = this.samples, half = new Float64Array(values.length);
    for (let n = 0; n < half.length; n++) half[n] = BAND_SDS * 1000 * sd[(n + scale.from) * counts.after + this.marker];
    const low = reduce(values.map((value, n) => value - half[n]), scale, () => true), high = reduce(values.map((value, n) => value + half[n]), scale, () => true);
    return { ...low, high: high.high };
  }

  strokeLine(context, { from, step, low, high }, y, style, lineWidth) {
    context.strokeStyle = style;
    context.lineWidth = lineWidth;
    context.beginPath();
    let isOpen = false;
    for (let n = 0; n < low.length; n++) {
      if (Number.isNaN(low[n])) { isOpen = false; continue; }
      const x = this.window.x(from + (n + 0.5) * step - 0.5);
      if (!isOpen) context.moveTo(x - 0.7, y(low[n]));
      context.lineTo(x, y(low[n]));
      if (high[n] > low[n]) context.lineTo(x, y(high[n]));
      isOpen = true;
    }
    context.stroke();
  }

  fillBand(context, { from, step, low, high }, y) {
    const x = (n) => this.window.x(from + (n + 0.5) * step - 0.5);
    for (let n = 0; n < low.length; n++) {
      if (Number.isNaN(low[n])) continue;
      const start = n;
      context.beginPath();
      for (; n < low.length && !Number.isNaN(low[n]); n++) context.lineTo(x(n), y(low[n]));
      for (let back = n - 1; back >= start; back--) context.lineTo(x(back), y(high[back]));
      context.fill();
    }
  }

  // Marks the frames in which the marker is rejected.
  fillRuns(context, { from }, state, row) {
    for (let n = 0; n < state.length; n++) {
      if (state[n] !== STATE.rejected) continue;
      const left = this.window.x(from + n - 0.5);
      while (state[n + 1] === STATE.rejected) n++;
      context.fillRect(left, row.top, Math.max(1.5, this.window.x(from + n + 0.5) - left), row.height);
    }
  }
}

// Returns the lowest and highest of the chosen values at each place, NaN where there are none.
function reduce(values, { step, from, count }, isChosen) {
  const low = new Float64Array(count).fill(NaN), high = new Float64Array(count).fill(NaN);
  for (let n = 0; n < values.length; n++) {
    const value = values[n];
    if (Number.isNaN(value) || !isChosen(n + from)) continue;
    const place = step === 1 ? n : Math.floor(n / step);
    if (!(low[place] <= value)) low[place] = value;
    if (!(high[place] >= value)) high[place] = value;
  }
  return { step, from, low, high };
}

function findRange(lines) {
  let low = Infinity, high = -Infinity;
  for (const line of lines) {
    for (const value of line.low) if (value < low) low = value;
    for (const value of line.high) if (value > high) high = value;
  }
  return low > high ? [0, 1] : [low, high];
}

function buildName(label, colour) {
  const name = document.createElement("b");
  name.textContent = label;
  name.style.color = `color-mix(in srgb, ${colour} 62%, var(--text))`;  // yellow on white could not be read
  return name;
}

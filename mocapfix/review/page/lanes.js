// The map of the take: a lane for each marker over time, with the outcome of each of its samples.

import { STATE } from "./samples.js";
import { TimeWindow } from "./window.js";

const ROW_PX = 13, LEFT = 92, RIGHT = 14, AXIS_PX = 15, CLICK_PX = 4, MIN_RUN_PX = 1.5, TICK_PX = 90;
const NAME = new RegExp("^.*:");

// How a sample was estimated, by a word in the method of its change: name and colour. Colours are those of Okabe and Ito, which
// the colour-blind tell apart.
const METHODS = [
  { word: "spline", name: "spline", colour: "#56b4e9" }, { word: "line between", name: "straight line", colour: "#8c96a0" },
  { word: "rigid group", name: "rigid group", colour: "#f0e442" }, { word: "move with it", name: "markers near it", colour: "#009e73" },
  { word: "body state", name: "similar frames", colour: "#3fc7a6" }, { word: "solved body", name: "body", colour: "#0072b2" },
  { word: "own motion", name: "its own motion", colour: "#56b4e9" }, { word: "interpolation", name: "interpolation", colour: "#8c96a0" },
  { word: "by hand", name: "set by hand", colour: "#d0a0ff" },
  { word: "place at which the foot", name: "held foot", colour: "#b07aa1" }, { word: "", name: "otherwise", colour: "#6f9bc4" },
];
const OUTCOMES = {
  [STATE.relabelled]: { name: "relabelled", colour: "#cc79a7" }, [STATE.reassigned]: { name: "moved to another label", colour: "#cc79a7" },
  [STATE.suspect]: { name: "faulty", colour: "#e69f00" }, [STATE.empty]: { name: "empty", colour: null },
  [STATE.rejected]: { name: "rejected", colour: "#d55e00" }, [STATE.measured]: { name: "measured", colour: "measured" },
};
const REPLACED_LINE = "#d55e00", DIFFERS = "#e6007a";
const FILLED = 16, REPLACED = 32;  // codes of estimated samples: plus the number of the method
const ORDERS = {
  missing: (a, b) => b.missing - a.missing, gap: (a, b) => b.longestGap - a.longestGap,
  error: (a, b) => b.worstMm - a.worstMm, body: (a, b) => a.marker - b.marker,
};

export const getMethodColour = (name) => METHODS.find((each) => each.name === name)?.colour ?? "";

export class LaneView {
  constructor({ onPick, onStretch }) {
    const find = (id) => document.getElementById(id);
    Object.assign(this, {
      box: find("lanes-scroll"), space: find("lanes-space"), canvas: find("lanes"), cursor: find("lanes-cursor"), legend: find("lanes-legend"),
      order: find("lanes-order"), onPick, onStretch, rows: [], markers: [], changes: [], stretch: null, frame: 0, drag: null,
    });
    this.window = new TimeWindow(this.canvas, {
      left: LEFT, right: RIGHT, onChange: () => this.draw(), accepts: (event) => event.offsetX > LEFT, box: this.box,
    });
    this.canvas.addEventListener("pointerdown", (event) => this.startDrag(event));
    this.canvas.addEventListener("pointermove", (event) => this.followPointer(event));
    this.canvas.addEventListener("pointerup", (event) => this.endDrag(event));
    this.canvas.addEventListener("dblclick", () => this.window.show(0, this.window.count - 1));
    this.box.addEventListener("scroll", () => this.draw());
    this.order.addEventListener("change", () => this.sort());
  }

  setTake(take, samples) {
    Object.assign(this, { take, samples, markers: [], changes: [], stretch: null });
    this.method = new Uint8Array(take.frame_count * take.labels.length).fill(METHODS.length - 1);
    for (const change of take.changes) {
      const number = METHODS.findIndex((each) => change.method.includes(each.word));
      if (number === METHODS.length - 1) continue;  // a swap over a gap leaves its samples the method of the gap
      for (const m of change.markers.map((label) => take.labels.indexOf(label)).filter((each) => each >= 0)) {
        for (let t = change.first; t <= change.last; t++) this.method[(t - take.first_frame) * take.labels.length + m] = number;
      }
    }
    const prefixes = new Set(take.labels.map((label) => label.match(NAME)?.[0] ?? ""));
    this.names = take.labels.map((label) => (prefixes.size === 1 ? label.replace(NAME, "") : label));
    Object.assign(this, { lanes: [], rows: [] });  // until the first samples have come
    this.window.setCount(take.frame_count);
  }

  // Reads the samples and decisions again.
  update() {
    const { take, samples } = this;
    if (!take) return;
    const worst = new Map();
    for (const change of take.changes) {
      for (const label of change.markers) worst.set(label, Math.max(worst.get(label) ?? 0, change.predicted_mm ?? 0));
    }
    this.lanes = take.labels.map((label, marker) => ({ marker, worstMm: worst.get(label) ?? -1, ...this.measureLane(marker, samples) }));
    this.renderLegend(new Set(this.lanes.flatMap((lane) => lane.runs.map((run) => run[2]))));
    this.sort();
  }

  // Names the colours that there are: a method of estimating once, whether samples were filled or replaced by it.
  renderLegend(codes) {
    const all = [...codes], methods = new Set(all.filter((code) => code >= FILLED).map((code) => FILLED + (code % FILLED)));
    const keys = [...all.filter((code) => code < FILLED), ...methods].sort((a, b) => a - b).map((code) => describeCode(code));
    if (all.some((code) => code >= REPLACED)) keys.push({ name: "replaced: line below", colour: "replaced" });
    if (this.take.difference?.samples) keys.push({ name: "differs from before", colour: "differs" });
    this.legend.replaceChildren(...keys.map(buildKey));
    this.legend.title = keys.map((each) => each.name).join(", ");
  }

  // Returns the runs [first, last, code] of a marker, how many samples are missing in the input, and how long the longest gap is.
  measureLane(marker, { state, before, counts, frameCount, requested }) {
    const runs = [], width = counts.after;
    let run = null, missing = 0, longestGap = 0, gap = 0;
    for (let t = 0, index = marker; t < frameCount; t++, index += width) {
      const outcome = state[index], method = requested.size && requested.has(index) ? this.findMethod(requested.get(index)) : this.method[index];
      const code = outcome === STATE.filled ? FILLED + method : outcome === STATE.replaced ? REPLACED + method : outcome;
      if (run && run[2] === code) run[1] = t;
      else runs.push(run = [t, t, code]);
      gap = Number.isNaN(before[index * 3]) ? gap + 1 : 0;
      if (gap) missing++;
      if (gap > longestGap) longestGap = gap;
    }
    return { runs, missing, longestGap };
  }

  findMethod(name) { return METHODS.findIndex((each) => each.name === name); }

  // Returns the first and last frame of the run of a marker that has a frame.
  findRun(marker, frame) { return this.lanes.find((each) => each.marker === marker).runs.find(([, last]) => frame <= last).slice(0, 2); }

  sort() {
    this.rows = [...this.lanes].sort((a, b) => ORDERS[this.order.value](a, b) || a.marker - b.marker);
    this.space.style.height = `${this.rows.length * ROW_PX + AXIS_PX}px`;
    this.draw();
  }

  // Shows which markers and changes are selected.
  select(markers, changes = []) {
    Object.assign(this, { markers, changes });
    const row = this.rows.findIndex((each) => each.marker === markers[0]), { box } = this, bottom = box.clientHeight - AXIS_PX;
    if (row >= 0 && (row * ROW_PX < box.scrollTop || (row + 1) * ROW_PX > box.scrollTop + bottom)) {
      box.scrollTop = Math.max(0, row * ROW_PX - bottom / 3);
    }
    this.draw();
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.draw();
  }

  setFrame(frame) {
    this.frame = frame;
    if (this.take && !this.window.isWhole) this.window.reveal(frame);
    this.placeCursor();
  }

  // Shows the frames around an interval, or the whole take if it shows a part already.
  toggleZoom([first, last]) {
    const margin = Math.max(0.5 * (last - first), 0.5 * this.take.rate);
    if (this.window.isWhole) this.window.show(first - margin, last + margin);
    else this.window.show(0, this.window.count - 1);
  }

  placeCursor() {
    this.cursor.hidden = !this.take;
    this.cursor.style.transform = `translateX(${this.window.x(this.frame) - 1}px)`;
  }

  // Lane and frame under the pointer; no lane beside them.
  locate(event) {
    const row = Math.floor((event.clientY - this.canvas.getBoundingClientRect().top + this.box.scrollTop) / ROW_PX);
    return { lane: this.rows[row] ?? null, frame: this.window.frameAt(event.clientX) };
  }

  startDrag(event) {
    if (!this.take || event.button || event.altKey) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.drag = { ...this.locate(event), x: event.clientX, isStretch: false };
  }

  followPointer(event) {
    if (!this.take) return;
    const { lane, frame } = this.locate(event);
    if (!this.drag) return this.explain(lane, frame);
    this.drag.isStretch ||= Math.abs(event.clientX - this.drag.x) > CLICK_PX;
    if (this.drag.isStretch) this.onStretch([Math.min(this.drag.frame, frame), Math.max(this.drag.frame, frame)], this.drag.lane?.marker ?? null);
  }

  endDrag(event) {
    if (this.drag && !this.drag.isStretch && this.drag.lane) this.onPick(this.drag.lane.marker, event.offsetX > LEFT ? this.drag.frame : null, event.ctrlKey || event.metaKey);
    this.drag = null;
  }

  explain(lane, frame) {
    const run = lane?.runs.find(([first, last]) => first <= frame && frame <= last);
    const share = lane ? ((100 * lane.missing) / this.take.frame_count).toFixed(1) : "";
    const [from, to] = run ? [run[0] + this.take.first_frame, run[1] + this.take.first_frame] : [];
    this.canvas.title = run ? `${this.take.labels[lane.marker]}: ${describeCode(run[2]).name}, frames ${from}–${to}; ${share} % missing` : "";
  }

  draw() {
    const { canvas, box } = this, width = box.clientWidth, height = box.clientHeight, ratio = Math.min(window.devicePixelRatio, 2);
    if (!this.take || !width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      Object.assign(canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
      Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
    }
    const context = canvas.getContext("2d", { willReadFrequently: true }), style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = "11px system-ui, sans-serif";
    const bottom = height - AXIS_PX, measured = colour("--lane"), selected = new Set(this.markers);
    const differing = new Map(this.take.difference?.markers.map((each) => [each.label, each.runs]));
    context.save();
    context.beginPath();
    context.rect(0, 0, width, bottom);
    context.clip();
    this.rows.forEach((lane, n) => {
      const top = n * ROW_PX - box.scrollTop;
      if (top + ROW_PX < 0 || top > bottom) return;
      if (selected.has(lane.marker)) {
        context.fillStyle = colour("--selected");
        context.fillRect(0, top, width, ROW_PX);
      }
      context.fillStyle = colour(selected.has(lane.marker) ? "--text" : "--muted");
      context.fillText(this.names[lane.marker], 6, top + ROW_PX - 3, LEFT - 12);
      this.drawRuns(context, lane.runs, top, measured);
    });
    this.shade(context, this.stretch, "rgba(224, 160, 48, 0.35)", bottom);
    context.strokeStyle = colour("--accent");
    for (const change of this.changes) this.outline(context, change);
    this.rows.forEach((lane, n) => {
      const runs = differing.get(this.take.labels[lane.marker]) ?? [];
      for (const [from, to] of runs) this.fillRun(context, from, to, n * ROW_PX - box.scrollTop, 2, DIFFERS);
    });
    context.restore();
    this.drawAxis(context, colour("--muted"), height, width);
    this.placeCursor();
  }

  drawRuns(context, runs, top, measured) {
    for (const [from, to, code] of runs) if (code === STATE.measured) this.fillRun(context, from, to, top + 5, 3, measured);
    for (const [from, to, code] of runs) {
      const { colour } = describeCode(code);
      if (colour && code !== STATE.measured) this.fillRun(context, from, to, top + 2, ROW_PX - 4, colour);
      if (code >= REPLACED) this.fillRun(context, from, to, top + ROW_PX - 4, 2, REPLACED_LINE);
      if (code === STATE.rejected) this.fillRun(context, from, to, top + 6, 1, "#fff");
    }
  }

  fillRun(context, from, to, top, height, colour) {
    if (to < this.window.first || from > this.window.last) return;
    const left = Math.max(this.window.x(from - 0.5), LEFT), right = Math.min(this.window.x(to + 0.5), LEFT + this.window.width);
    context.fillStyle = colour;
    context.fillRect(left, top, Math.max(right - left, MIN_RUN_PX), height);
  }

  shade(context, interval, fill, height) {
    if (!interval) return;
    const from = Math.max(this.window.x(interval[0]), LEFT), to = Math.min(this.window.x(interval[1]), LEFT + this.window.width);
    context.fillStyle = fill;
    if (to >= from) context.fillRect(from - 1, 0, Math.max(2, to - from + 2), height);
  }

  outline(context, change) {
    const from = Math.max(this.window.x(change.first - this.take.first_frame - 0.5), LEFT);
    const to = Math.min(this.window.x(change.last - this.take.first_frame + 0.5), LEFT + this.window.width);
    if (to < from) return;
    this.rows.forEach((lane, n) => {
      if (!change.markers.includes(this.take.labels[lane.marker])) return;
      context.strokeRect(from - 1, n * ROW_PX - this.box.scrollTop + 0.5, Math.max(3, to - from + 2), ROW_PX - 1);
    });
  }

  drawAxis(context, colour, height, width) {
    const { first, last } = this.window, raw = ((last - first) * TICK_PX) / this.window.width, power = 10 ** Math.floor(Math.log10(Math.max(raw, 1)));
    const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= raw) ?? power, start = this.take.first_frame;
    context.fillStyle = colour;
    for (let number = Math.ceil((first + start) / step) * step; number <= last + start; number += step) {
      const x = this.window.x(number - start), text = String(number);
      context.fillRect(x, height - AXIS_PX, 1, 4);
      context.fillText(text, Math.min(x + 3, width - context.measureText(text).width - 2), height - 3);
    }
  }
}

function describeCode(code) {
  if (code >= REPLACED) return { name: `replaced: ${METHODS[code - REPLACED].name}`, colour: METHODS[code - REPLACED].colour };
  if (code >= FILLED) return { name: METHODS[code - FILLED].name, colour: METHODS[code - FILLED].colour };
  return OUTCOMES[code];
}

function buildKey({ name, colour }) {
  const key = document.createElement("span"), dot = document.createElement("i");
  dot.className = { measured: "key measured", replaced: "key replaced", differs: "key differs" }[colour] ?? (colour ? "key" : "key empty");
  if (dot.className === "key") dot.style.background = colour;
  key.append(dot, name);
  return key;
}

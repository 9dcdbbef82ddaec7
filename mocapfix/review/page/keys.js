// Points of a marker that the reviewer sets by hand over time, and the spline through them.

import { AddEdit } from "./edits.js";
import { getMethodColour } from "./lanes.js";
import { buildSpline } from "./samples.js";

const find = (id) => document.getElementById(id);
const AXES = ["x", "y up", "z"];
const NAME = "set by hand";
const byFrame = ([one], [other]) => one - other;

export class KeyEditor {
  // `onShow` is called with the spline as an estimate that is shown, `send` with an edit; it resolves to whether that was saved.
  constructor({ onShow, onOpen, send, showStatus }) {
    Object.assign(this, { onShow, onOpen, send, showStatus, points: new Map(), axis: 1 });
  }

  get isOpen() { return this.points.size > 0; }

  // Sets a coordinate (0 to 2) of the point at a frame index, in metres; a new point is on the path that is shown.
  set(app, frame, axis, value) {
    if (!this.isOpen) {
      this.onOpen();
      Object.assign(this, { take: app.take, samples: app.samples, marker: app.marker, stretch: app.stretch ?? app.findChangeFrames() });
    }
    const point = this.points.get(frame) ?? this.readShown(frame);
    if (value !== null) point[axis] = value;
    if (value !== null) this.axis = axis;
    if (point.some(Number.isNaN)) return this.showStatus("Nothing is shown at this frame: click all three curves, or begin beside it.", true);
    this.points.set(frame, point);
    this.render();
  }

  // The path at a frame: the spline where there is one; where nothing is shown, the nearest point.
  readShown(frame) {
    const spline = this.buildSpline(), at = (frame - spline.from) * 3, own = spline.layer.values.subarray(at, at + 3);
    if (at >= 0 && own.length && !Number.isNaN(own[0])) return [...own];
    const shown = this.samples.getPosition("after", frame, this.marker);
    if (!Number.isNaN(shown[0])) return shown;
    const nearest = [...this.points.keys()].sort((a, b) => Math.abs(a - frame) - Math.abs(b - frame))[0];
    return nearest === undefined ? this.findNeighbour(frame) : [...this.points.get(nearest)];
  }

  findNeighbour(frame) {
    for (let reach = 1; reach < this.take.frame_count; reach++) {
      for (const t of [frame - reach, frame + reach]) {
        const shown = t >= 0 && t < this.take.frame_count ? this.samples.getPosition("after", t, this.marker) : [NaN];
        if (!Number.isNaN(shown[0])) return shown;
      }
    }
    return [NaN, NaN, NaN];
  }

  // Adds a point at a frame, or removes it.
  toggle(app, frame) {
    if (!this.points.has(frame)) return this.set(app, frame, this.axis, null);
    this.points.delete(frame);
    if (this.isOpen) this.render();
    else this.close();
  }

  move(app, frame, byM) {
    if (this.points.has(frame)) this.set(app, frame, this.axis, this.points.get(frame)[this.axis] + byM);
    else this.showStatus("There is no point at this frame: J sets one.", true);
  }

  nextAxis() {
    this.axis = (this.axis + 1) % 3;
    if (this.isOpen) this.render();
  }

  // The first and last frame that are set: those of the chosen stretch or the change, if the points are within it, else of the points.
  get interval() {
    const frames = [...this.points.keys()].sort((a, b) => a - b), own = [frames[0], frames.at(-1)];
    return this.stretch && this.stretch[0] <= own[0] && own[1] <= this.stretch[1] ? this.stretch : own;
  }

  buildSpline() {
    const [first] = this.interval, values = buildSpline(this.samples, this.marker, [...this.points], this.interval);
    return { number: "", name: NAME, colour: getMethodColour(NAME), from: first, length: values.length / 3, layer: { values, counts: { values: 1 } }, points: this.points };
  }

  render() {
    const [first, last] = this.interval.map((each) => each + this.take.first_frame), { size } = this.points, bar = find("fills");
    bar.hidden = false;
    const text = document.createElement("span"), buttons = [["Set", "Enter", () => this.apply()], ["Discard", "Escape", () => this.close()]];
    text.textContent = `${this.take.labels[this.marker]}, frames ${first}–${last}: ${size} ${size === 1 ? "point" : "points"} by hand; Shift-↑ ↓ moves ${AXES[this.axis]} (Y: another axis)`;
    bar.replaceChildren(text, ...buttons.map(([name, key, run]) => {
      const button = document.createElement("button"), shown = document.createElement("kbd");
      shown.textContent = key;
      button.append(name, " ", shown);
      button.addEventListener("click", run);
      return button;
    }));
    bar.children[1].disabled = size < 2;
    this.onShow([this.buildSpline()]);
  }

  async apply() {
    if (this.points.size < 2) return this.showStatus("A spline needs two points or more: J or Ctrl-click sets one.", true);
    const [first, last] = this.interval, start = this.take.first_frame, round = (each) => Math.round(each * 1e5) / 100;
    const points = [...this.points].sort(byFrame).map(([t, at]) => [t + start, ...at.map(round)]);
    const correction = { kind: "keys", markers: [this.take.labels[this.marker]], first: first + start, last: last + start, points };
    this.close();
    await this.send(new AddEdit(correction));
  }

  close() {
    if (!this.isOpen && find("fills").hidden) return;
    this.points = new Map();
    find("fills").hidden = true;
    this.onShow([]);
  }
}

/** The take that is shown, what is selected in it, and the parts of the page that show it. */

import { getSession, getTake } from "./api.js";
import { Actions } from "./actions.js";
import { ChangeList } from "./changes.js";
import { Connection } from "./connection.js";
import { Curves } from "./curves.js";
import { EditQueue } from "./edits.js";
import { count, fillOptions, find } from "./elements.js";
import { Events } from "./events.js";
import { MarkerLabels, listLabels } from "./labels.js";
import { renderCorrections, renderNotes } from "./panels.js";
import { Playback, PlaybackBar } from "./playback.js";
import { Samples } from "./samples.js";
import { createScene } from "./empty-scene.js";

/** How often the bar and the line in the curves move while playing, if drawing is slow. */
const SLOW_UPDATE_MS = 90;

export class App {
  constructor() {
    Object.assign(this, { session: null, take: null, samples: null, selected: null, correction: null, marker: -1, trajectory: null });
    Object.assign(this, { stretch: null, hovered: null, isClosed: false, generation: 0 });
    this.scene = createScene(find("scene"), () => this.requestDraw());
    this.playback = new Playback(() => this.showFrame());
    this.bar = new PlaybackBar(this.playback, find);
    this.curves = new Curves(find("curves"), find("curves-cursor"), {
      seek: (frame) => this.seek(frame), selectStretch: (stretch) => this.setStretch(stretch) });
    this.events = new Events(this);
    this.labels = new MarkerLabels(find("label-layer"));
    this.list = new ChangeList(find("changes"), (id) => this.select(id));
    this.connection = new Connection({
      receive: (event) => this.events.receive(event), resume: () => this.events.resume(), cover: (text) => this.cover(text) });
    this.edits = new EditQueue(this, this.connection);
    this.actions = new Actions(this);
  }

  get frame() {
    return this.playback.frame;
  }

  get isRunning() {
    return this.take?.run.state === "running";
  }

  async start() {
    this.connection.open();
    await this.load();
  }

  async load() {
    try {
      await this.refreshSession();
      const wanted = decodeURIComponent(location.hash.slice(1)), ids = this.session.takes.map(({ id }) => id);
      await this.openTake(ids.includes(wanted) ? wanted : ids[0]);
    } catch (error) {
      this.report(error.message, true);
    }
  }

  /** Load a take; without `kept` its least sure change is selected. */
  async openTake(id, kept = null) {
    const generation = this.generation += 1;
    delete document.documentElement.dataset.ready;
    this.playback.pause();
    await this.edits.idle;
    let take;
    try {
      take = await getTake(id);
    } catch (error) {
      if (generation !== this.generation) return;
      this.report(error.message, true);
      if (this.samples) document.documentElement.dataset.ready = "1";
      return;
    }
    if (generation !== this.generation) return;
    if (this.samples) this.samples.isStopped = true;
    Object.assign(this, { take, samples: new Samples(take), stretch: null, correction: null, hovered: null, trajectory: null, selected: null });
    this.isFramingPending = kept === null;
    history.replaceState(null, "", `#${encodeURIComponent(id)}`);
    document.title = `${take.name} – mocapfix review`;
    find("take-name").textContent = take.subject ? `${take.name}, ${take.subject}` : take.name;
    this.playback.setTake(take, kept?.frame ?? 0);
    this.bar.setTake(take);
    this.scene.setTake(take);
    this.curves.setTake(take, this.samples);
    this.marker = Math.max(0, take.labels.indexOf(kept?.label));
    fillOptions(find("curve-marker"), take.labels.map((label, index) => [String(index), label]), String(this.marker));
    renderNotes(take);
    this.showReview();
    const first = take.changes.some((change) => change.id === kept?.selected) ? kept.selected : this.list.listed[0]?.id;
    if (first && kept) this.mark(first);
    else if (first) this.select(first);
    this.showCurves();
    try {
      await this.loadSamples(generation);
    } catch (error) {
      if (generation === this.generation) this.report(error.message, true);
    }
  }

  async loadSamples(generation) {
    const { samples } = this;
    let isFirst = true;
    await samples.load(() => this.frame, (first, last) => {
      if (generation !== this.generation) return;
      const [start, end] = this.curves.window;
      if (first <= end && last >= start) this.curves.redraw();
      if (this.isFramingPending && samples.hasFrame(this.frame)) this.frameSelected(isFirst);
      if (this.frame >= first && this.frame <= last) this.showFrame();
      if (!isFirst) return;
      isFirst = false;
      this.scene.settle(samples, this.frame);
      this.draw(performance.now());
      document.documentElement.dataset.ready = "1";
    });
  }

  async refreshSession() {
    this.session = await getSession();
    find("open-takes").hidden = this.session.takes.length < 2;
  }

  /** Take over what the server holds of the review of this take. */
  async refreshReview() {
    try {
      const { id } = this.take, take = await getTake(id);
      if (this.take.id === id) this.takeOver(take);
    } catch (error) {
      this.report(error.message, true);
    }
  }

  takeOver({ revision, state, changes, corrections, undo_count, approval }, action) {
    Object.assign(this.take, { revision, state, changes, corrections, undo_count, approval });
    if (this.correction >= corrections.length || action?.type === "remove") this.correction = null;
    this.showReview();
    this.showCurves();
    if (action?.type === "add") find("corrections").scrollTop = find("corrections").scrollHeight;
  }

  showReview() {
    this.list.setTake(this.take);
    renderCorrections(this);
    this.showState();
    this.bar.drawMarks(this.take.changes, this.selected);
  }

  showState() {
    const { state, approval, run, can_clean: canClean, cannot_clean_reason: reason } = this.take, element = find("take-state");
    const isApproved = state === "approved" && approval;
    element.textContent = isApproved ? `approved by ${approval.name}` : state;
    element.dataset.state = state;
    element.title = isApproved ? approval.date : approval ? `Approved by ${approval.name}, and changed since.` : "";
    find("approve").textContent = isApproved ? "Withdraw" : "Approve";
    const clean = find("clean");
    clean.textContent = this.isRunning ? `Stop: ${run.stage || "starting"}` : "Clean again";
    clean.disabled = !canClean && !this.isRunning;
    clean.title = canClean ? "Clean the take again with your decisions (C)" : reason;
    find("export").disabled = !canClean || this.isRunning;
    document.documentElement.toggleAttribute("data-running", this.isRunning);
    for (const button of document.querySelectorAll("[data-action], #approve")) button.disabled = this.isRunning;
  }

  getChange(id = this.selected) {
    return this.take?.changes.find((change) => change.id === id) ?? null;
  }

  /** Select a change, go to its middle and show its markers. */
  select(id) {
    const change = this.getChange(id);
    if (!change) return;
    this.mark(id);
    const marker = this.take.labels.indexOf(change.markers.find((label) => this.take.labels.includes(label)));
    if (marker >= 0) this.setMarker(marker, false);
    this.playback.pause();
    this.isFramingPending = true;
    this.playback.seek(Math.floor((change.first + change.last) / 2) - this.take.first_frame);
    this.showCurves();
    if (this.samples.hasFrame(this.frame)) this.frameSelected(false);
  }

  /** Select a change without going there. */
  mark(id) {
    Object.assign(this, { selected: id, correction: null, stretch: null });
    this.list.setSelected(id);
    renderCorrections(this);
    this.bar.drawMarks(this.take.changes, id);
  }

  selectCorrection(index) {
    const correction = this.take.corrections[index];
    if (!correction) return;
    Object.assign(this, { correction: index, stretch: null });
    renderCorrections(this);
    const marker = this.take.labels.indexOf(correction.markers[0]);
    if (marker >= 0) this.setMarker(marker, false);
    this.playback.pause();
    this.playback.seek(Math.floor((correction.first + correction.last) / 2) - this.take.first_frame);
    this.showCurves();
    if (this.samples.hasFrame(this.frame)) this.frameSelected(false);
  }

  /** The interval that is looked at, in frame indices: of the selected correction or change, else this frame. */
  getInterval() {
    const entry = this.take.corrections[this.correction] ?? this.getChange();
    return entry ? [entry.first - this.take.first_frame, entry.last - this.take.first_frame] : [this.frame, this.frame];
  }

  listSelectedMarkers() {
    const entry = this.take.corrections[this.correction] ?? this.getChange();
    const markers = new Set((entry?.markers ?? []).map((label) => this.take.labels.indexOf(label)).filter((marker) => marker >= 0));
    if (this.marker >= 0) markers.add(this.marker);
    return [...markers];
  }

  setMarker(marker, isCurveShown = true) {
    this.marker = marker;
    find("curve-marker").value = String(marker);
    if (isCurveShown) this.showCurves();
    this.showFrame();
  }

  setStretch(stretch) {
    this.stretch = stretch;
    this.showCurves();
  }

  showCurves() {
    const number = (frame) => frame + this.take.first_frame;
    this.curves.setContent(this.marker, this.getInterval(), this.stretch);
    this.curves.showFrame(this.frame);
    find("curves-text").textContent = this.stretch ? `Stretch: ${number(this.stretch[0])}–${number(this.stretch[1])}, `
      + `${count(this.stretch[1] - this.stretch[0] + 1, "frame")} (Esc clears it)` : "Shift-drag, or [ and ], selects a stretch.";
  }

  seek(frame) {
    if (this.take) this.playback.seek(frame);
  }

  frameSelected(isAtOnce) {
    this.isFramingPending = false;
    const isShown = this.scene.frame(this.samples, this.frame, this.listSelectedMarkers(), null, isAtOnce);
    if (!isShown) this.scene.frame(this.samples, this.frame, null, null, isAtOnce);
  }

  /** Write the samples of this frame into the scene, and draw it. */
  showFrame() {
    if (!this.samples) return;
    this.scene.showFrame(this.samples, this.frame, this.marker, this.listSelectedMarkers());
    this.requestDraw();
    const now = performance.now();
    if (this.playback.isPlaying && this.scene.isSlow && now - this.placedAt < SLOW_UPDATE_MS) return;
    this.placedAt = now;
    this.showPlace();
  }

  /** Show the frame in the bar and in the curves. */
  showPlace() {
    this.bar.update();
    this.curves.showFrame(this.frame);
  }

  requestDraw() {
    this.isStale = true;
    this.schedule();
  }

  schedule() {
    this.drawing ||= requestAnimationFrame((now) => {
      this.drawing = 0;
      if (this.samples) this.draw(now);
    });
  }

  draw(now) {
    if (this.playback.advance(now)) this.showFrame();
    this.scene.advance(now);
    if (this.isStale) {
      this.isStale = false;
      this.scene.draw();
      this.labels.place(listLabels(this));
      if (this.playback.isPlaying) this.scene.adapt(this.playback.countFrame(now));
    }
    if (this.playback.isPlaying || this.scene.turn) this.schedule();
    else this.showPlace();
  }

  report(text, isProblem = false) {
    const status = find("status");
    status.textContent = text;
    status.title = text;
    status.classList.toggle("problem", isProblem);
  }

  cover(text) {
    find("cover").textContent = text;
    find("cover").hidden = !text;
  }

  close() {
    this.isClosed = true;
    this.playback.pause();
    for (const dialog of document.querySelectorAll("dialog[open]")) dialog.close();
    this.connection.end();
  }

  run(name, argument) {
    if (this.take || ["showHelp", "end"].includes(name)) this.actions[name](argument);
  }
}

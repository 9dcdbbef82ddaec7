// The page of a review: loads a take, and connects its views with the decisions.

import * as api from "./api.js";
import { correctionActions, outputActions } from "./actions.js";
import { CharacterView } from "./character.js";
import { ChangeList, listChanges, renderCorrections } from "./changes.js";
import { connectControls } from "./controls.js";
import { CurveView } from "./curves.js";
import * as dialogs from "./dialogs.js";
import { EditQueue } from "./editing.js";
import { followKeys } from "./keys.js";
import { labelPlacement } from "./labels.js";
import { renderDetail, renderDifference, renderTakes } from "./panels.js";
import { Playback } from "./playback.js";
import { Samples } from "./samples.js";
import { SceneView } from "./scene.js";

const find = (id) => document.getElementById(id);

class App {
  constructor() {
    Object.assign(this, { take: null, samples: null, session: null, selectedId: null, correctionIndex: null, marker: null, stretch: null, isReady: false });
    this.playback = new Playback({ onFrame: (frame) => this.showFrame(frame) });
    this.scene = new SceneView(find("scene"));
    this.curves = new CurveView(find("curves"), find("curves-title"), find("curves-cursor"), {
      onScrub: (frame) => this.playback.moveTo(frame), onStretch: (stretch) => this.setStretch(stretch),
    });
    this.list = new ChangeList(find("changes"), { onSelect: (id) => this.select(id) });
    this.edits = new EditQueue({
      getTake: () => this.take, applyReview: (take, review) => this.applyReview(take, review), showStatus: (...args) => this.showStatus(...args),
    });
    this.scene.afterRender = () => this.placeLabels();
    dialogs.prepareDialogs();
    this.applyTheme(localStorage.getItem("theme"));
    connectControls(this);
    followKeys(this);
    const animate = (time) => {
      this.playback.advance(time);
      this.scene.renderIfNeeded();
      requestAnimationFrame(animate);
    };
    requestAnimationFrame(animate);
  }

  async start() {
    try {
      this.session = await api.fetchSession();
      const asked = decodeURIComponent(location.hash.slice(1)), { takes } = this.session;
      const first = takes.find((each) => each.id === asked) ?? takes.find((each) => each.state !== "approved" && !each.error) ?? takes[0];
      await this.openTake(first.id);
    } catch (error) {
      this.cover(error.message);
    }
    this.events = api.followEvents((event) => this.receive(event), (isConnected) => this.showConnection(isConnected));
  }

  async openTake(id, frame = null) {
    delete document.documentElement.dataset.ready;
    this.isReady = false;
    if (this.samples) this.samples.isCancelled = true;
    this.playback.toggle(false);
    const isSame = this.take?.id === id;
    const take = await api.fetchTake(id);
    this.take = take;
    this.samples = new Samples(take);
    this.stretch = null;
    this.correctionIndex = null;
    history.replaceState(null, "", `#${encodeURIComponent(id)}`);
    find("take-name").textContent = take.subject ? `${take.name} (${take.subject})` : take.name;
    find("take-name").title = take.notes.join("\n");
    document.title = `${take.name} – mocapfix review`;
    this.scene.setTake(take, this.samples);
    this.curves.setTake(take, this.samples);
    this.playback.setTake(take);
    this.renderKinds();
    this.renderReview();
    this.offerCharacters(take);
    const kept = isSame && take.changes.some((each) => each.id === this.selectedId) ? this.selectedId : this.list.rows[0]?.id ?? null;
    const change = take.changes.find((each) => each.id === kept);
    const target = frame ?? (change ? this.middleOf(change) : 0);
    const load = this.samples.load(target, () => this.drawBlock(take, kept, target));
    this.isComplete = false;
    load.then(() => { this.isComplete = this.take === take; }).catch((error) => this.showStatus(error.message, true));
    this.showRun(take.run);
    renderDifference(find("difference"), take.difference, (id) => this.select(id));
  }

  // Lists the written characters, and shows the first.
  offerCharacters(take) {
    find("character-box").hidden = !take.characters.length;
    find("character").replaceChildren(...take.characters.map((name) => new Option(name, name)), new Option("no character", ""));
    this.showCharacter(take.characters[0] ?? "");
  }

  async showCharacter(name) {
    const { take } = this;
    try {
      const character = name ? await CharacterView.load(api.getCharacterUrl(take.id, name)) : null;
      if (this.take === take && find("character").value === name) this.scene.setCharacter(character);
    } catch (error) {
      this.showStatus(`${name} cannot be shown: ${error.message}`, true);
    }
  }

  // Draws after a block of samples has come; selects the first change when it is the first.
  drawBlock(take, selectedId, frame) {
    if (this.take !== take) return;
    if (this.isReady) {
      this.showFrame(this.playback.frame);
      this.curves.draw();
      return;
    }
    this.isReady = true;
    this.playback.moveTo(frame);
    this.scene.frameMarkers(null, [0.6, 0.35, 1]);
    if (selectedId) this.select(selectedId);
    this.scene.renderIfNeeded();
    document.documentElement.dataset.ready = "1";
  }

  get lastFrame() { return this.take.frame_count - 1; }
  get change() { return this.take?.changes.find((each) => each.id === this.selectedId) ?? null; }
  toIndex(frame) { return frame - this.take.first_frame; }
  middleOf(change) { return this.toIndex(Math.floor((change.first + change.last) / 2)); }

  // Indices of the labelled markers among some labels.
  findMarkers(labels) { return labels.map((label) => this.take.labels.indexOf(label)).filter((index) => index >= 0); }

  showFrame(frame) {
    if (!this.samples) return;
    if (this.playback.isPlaying && this.scene.frame !== undefined) this.scene.follow(this.scene.frame, frame);
    const markers = this.marker === null ? [] : [this.marker, ...this.findMarkers(this.change?.markers ?? [])];
    this.scene.showFrame(frame, markers);
    this.curves.setFrame(frame);
  }

  select(id, { keepsFrame = false } = {}) {
    this.selectedId = id;
    this.correctionIndex = null;
    const change = this.change;
    this.list.selectedId = id;
    this.list.showSelected();
    renderDetail(find("change-detail"), change);
    this.renderCorrections();
    if (!change) return;
    const markers = this.findMarkers(change.markers);
    this.marker = markers[0] ?? null;
    this.curves.frame = this.middleOf(change);
    if (this.marker !== null) this.curves.showMarker(this.marker, [this.toIndex(change.first), this.toIndex(change.last)]);
    if (!keepsFrame) {
      this.playback.moveTo(this.middleOf(change));
      if (markers.length) this.scene.frameMarkers(markers, null, 0.5);
    }
  }

  selectNeighbour(steps) {
    const id = this.list.findNeighbour(steps);
    if (id) this.select(id);
  }

  selectInTime(direction) {
    const now = this.playback.frame + this.take.first_frame;
    const ordered = [...this.list.rows].sort((a, b) => direction * (a.first - b.first));
    const next = ordered.find((each) => direction * (Math.floor((each.first + each.last) / 2) - now) > 0);
    if (next) this.select(next.id);
  }

  async decide(decision) {
    const { change } = this;
    if (!change) return;
    const next = this.list.findNextOpen();
    if ((await this.edits.send({ type: "decide", ids: [change.id], decision })) && next && this.selectedId === change.id) this.select(next);
  }

  async acceptKind() {
    const { change } = this;
    if (!change) return;
    const ids = this.take.changes.filter((each) => each.kind === change.kind && !each.is_reviewed).map((each) => each.id);
    const text = `${ids.length} changes of the kind "${change.kind}" are not reviewed. Accept them?`;
    if (ids.length && (await dialogs.confirmAction(`Accept all of the kind "${change.kind}"`, text))) {
      await this.edits.send({ type: "decide", ids, decision: "accept" });
    }
  }

  async note() {
    const { change } = this;
    if (!change) return;
    const text = await dialogs.askNote(change.id, change.note);
    if (text !== null) await this.edits.send({ type: "note", id: change.id, text });
  }

  undo() { return this.edits.send({ type: "undo" }); }

  setStretch(stretch) {
    this.stretch = stretch;
    this.curves.setStretch(stretch);
  }

  setStretchEnd(end) {
    const { frame } = this.playback, [first, last] = this.stretch ?? [frame, frame];
    this.setStretch(end === "first" ? [frame, Math.max(frame, last)] : [Math.min(first, frame), frame]);
  }

  async openNextTake() {
    const { takes } = this.session, at = takes.findIndex((each) => each.id === this.take.id);
    const next = [...takes.slice(at + 1), ...takes.slice(0, at)].find((each) => each.state !== "approved" && !each.error);
    if (!next) return this.showStatus("All other takes are approved.");
    await this.report(() => this.openTake(next.id));
  }

  frameSelected() { this.scene.frameMarkers(this.change ? this.findMarkers(this.change.markers) : this.marker === null ? null : [this.marker]); }
  showHelp() { dialogs.showHelp(); }

  toggleTakes() {
    find("takes").hidden = !find("takes").hidden;
    this.renderTakes();
  }

  leave() {
    this.setStretch(null);
    find("takes").hidden = true;
    find("difference").hidden = true;
  }

  toggleLayer(name) {
    const box = find(`show-${name}`);
    box.checked = !box.checked;
    box.dispatchEvent(new Event("change"));
  }

  switchTheme() { this.applyTheme(this.isDark ? "light" : "dark"); }

  get isDark() {
    const { theme } = document.documentElement.dataset;
    return theme === "dark" || (theme !== "light" && matchMedia("(prefers-color-scheme: dark)").matches);
  }

  applyTheme(theme) {
    document.documentElement.dataset.theme = theme ?? "auto";
    if (theme) localStorage.setItem("theme", theme);
    this.scene.setTheme(this.isDark);
    if (this.samples && this.isReady) this.showFrame(this.playback.frame);
    this.curves.draw();
    this.playback.drawMarks();
  }

  applyReview(take, review) {
    const { changed = [], ...rest } = review, byId = new Map(changed.map((each) => [each.id, each]));
    Object.assign(take, rest);
    if (byId.size) take.changes = take.changes.map((each) => byId.get(each.id) ?? each);
    if (take !== this.take) return;
    this.renderReview();
    const entry = this.session?.takes.find((each) => each.id === take.id);
    if (entry) Object.assign(entry, { state: take.state, reviewed_count: take.changes.filter((each) => each.is_reviewed).length });
    this.renderTakes();
  }

  renderReview() {
    const { take } = this;
    const filters = { kind: find("filter-kind").value, marker: find("filter-marker").value, decision: find("filter-decision").value, order: find("sort").value };
    const rows = listChanges(take.changes, filters), reviewed = take.changes.filter((each) => each.is_reviewed).length;
    find("takes-button").hidden = !this.session?.is_batch;
    this.list.setRows(rows, this.selectedId, take);
    find("count").textContent = `${reviewed} of ${take.changes.length} reviewed`;
    find("take-state").textContent = take.state === "approved" ? `approved by ${take.approval.name}` : take.state;
    find("take-state").dataset.state = take.state;
    find("approve").textContent = take.state === "approved" ? "Withdraw" : "Approve";
    find("undo").disabled = !take.undo_count;
    renderDetail(find("change-detail"), this.change);
    this.renderCorrections();
    this.playback.drawMarks();
  }

  renderCorrections() {
    renderCorrections(find("corrections"), this.take.corrections, this.correctionIndex, {
      onSelect: (index) => this.selectCorrection(index), onRemove: (index) => this.removeCorrection(index),
    });
  }

  selectCorrection(index) {
    this.correctionIndex = index;
    this.renderCorrections();
    const correction = this.take.corrections[index], [marker] = this.findMarkers(correction.markers);
    if (marker !== undefined) {
      this.marker = marker;
      this.curves.showMarker(marker, [this.toIndex(correction.first), this.toIndex(correction.last)]);
      this.playback.moveTo(this.middleOf(correction));
    }
  }

  renderKinds() {
    const kinds = [...new Set(this.take.changes.map((each) => each.kind))].sort(), chosen = find("filter-kind").value;
    find("filter-kind").replaceChildren(new Option("all kinds", ""), ...kinds.map((kind) => new Option(kind, kind, false, kind === chosen)));
  }

  renderTakes() {
    renderTakes(find("takes"), this.session?.takes ?? [], this.take?.id, (id) => this.report(() => this.openTake(id)));
  }

  receive(event) {
    if (event.type === "closing") this.cover("The review has ended. You can close this page.");
    if (event.type === "session") this.report(async () => { this.session = await api.fetchSession(); this.renderTakes(); });
    if (event.take !== this.take?.id) return;
    if (event.type === "edited" && !this.edits.waiting && event.revision !== this.take.revision) this.report(() => this.refreshReview());
    if (event.type === "run") this.showRun(event.run);
  }

  async refreshReview() {
    const { take } = this, fresh = await api.fetchTake(take.id);
    if (fresh.revision !== take.revision) this.applyReview(take, fresh);
  }

  showRun(run) {
    const wasRunning = this.take.run.state === "running" || run.state === "running" || this.wasRunning;
    this.take.run = run;
    const isRunning = run.state === "running";
    for (const id of ["accept", "reject", "keep", "note", "mark", "swap", "assign", "fill", "approve", "export"]) find(id).disabled = isRunning;
    find("clean").textContent = isRunning ? "Stop" : "Clean again";
    if (isRunning) this.showStatus(`Cleaning again: ${run.stage} …`);
    if (run.state === "failed" && wasRunning) this.showStatus(run.message, true);
    if (run.state === "done" && this.wasRunning) {
      const written = this.exported ? ` Written: ${this.exported.join(", ")}.` : "";
      this.exported = null;
      this.report(async () => { await this.openTake(this.take.id, this.playback.frame); this.showStatus(`Cleaned again.${written}`); });
    }
    this.wasRunning = isRunning;
  }

  showConnection(isConnected) {
    if (this.hasEnded) return;
    if (isConnected && this.isLost) location.reload();
    this.isLost = !isConnected;
    if (!isConnected) this.showStatus("The connection to the review is lost; is `mocapfix review` still running? Trying again …", true);
  }

  showStatus(text, isError = false) {
    find("status").textContent = text;
    find("status").title = text;
    find("status").classList.toggle("error", isError);
  }

  cover(text) {
    this.hasEnded = true;
    this.events?.close();
    find("cover").textContent = text;
    find("cover").hidden = false;
  }
}

Object.assign(App.prototype, correctionActions, outputActions, labelPlacement);

const app = new App();
window.review = { app, getFrameRate: () => app.playback.frameRate, getState: () => ({ frame: app.playback.frame, selected: app.selectedId, take: app.take, isComplete: app.isComplete }) };
app.start();

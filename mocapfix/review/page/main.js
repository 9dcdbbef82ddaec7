// The page of a review: loads a take, and connects its views with the decisions.

import * as api from "./api.js";
import { correctionActions, outputActions } from "./actions.js";
import { CharacterView } from "./character.js";
import { ChangeList, renderCorrections } from "./changes.js";
import { connectCommands, LARGE_STEP } from "./commands.js";
import { connectControls } from "./controls.js";
import { CurveView } from "./curves.js";
import * as dialogs from "./dialogs.js";
import { DecideEdit, EditQueue, NoteEdit, RedoEdit, UndoEdit } from "./edits.js";
import { listEvents, listRows } from "./events.js";
import { FillPreview } from "./fills.js";
import { KeyEditor } from "./keys.js";
import { labelCorrection, labelPlacement } from "./labels.js";
import { LaneView } from "./lanes.js";
import { LimitBar } from "./limit.js";
import { orderTakes, renderDetail, renderDifference, renderTakes } from "./panels.js";
import { Playback } from "./playback.js";
import { Samples } from "./samples.js";
import { FIRST_DIRECTION, SceneView } from "./scene.js";

const find = (id) => document.getElementById(id);
const firstSession = api.fetchSession();  // the views are built meanwhile

class App {
  constructor() {
    Object.assign(this, {
      take: null, samples: null, session: null, events: [], unfolded: new Set(), selectedId: null, correctionIndex: null, marker: null, stretch: null,
      isReady: false,
    });
    this.playback = new Playback({ onFrame: (frame) => this.showFrame(frame) });
    this.scene = new SceneView(find("scene"));
    this.curves = new CurveView(find("curves"), {
      onScrub: (frame) => this.playback.moveTo(frame), onStretch: (stretch) => this.setStretch(stretch),
      onKey: (frame, axis, value) => this.setKey(frame, axis, value), onRemoveKey: (frame) => this.keys.toggle(this, frame), onError: (text) => this.showStatus(text, true),
    });
    this.lanes = new LaneView({
      onPick: (marker, frame, isAdded) => this.pickLane(marker, frame, isAdded, true), onStretch: (stretch, marker) => this.setStretch(stretch, marker),
    });
    this.list = new ChangeList(find("changes"), { onSelect: (id) => this.select(id), onFold: (id) => this.toggleFold(id) });
    this.limit = new LimitBar({
      getEvents: () => this.events, getTake: () => this.take,
      onAccept: (changes) => this.allows("accept") && this.edits.send(new DecideEdit(changes, "accept")),
    });
    this.edits = new EditQueue({
      getTake: () => this.take, applyReview: (take, review) => this.applyReview(take, review), showStatus: (...args) => this.showStatus(...args),
    });
    this.fills = new FillPreview({
      onShow: (estimates) => this.showEstimates(estimates), send: (edit) => this.edits.send(edit), showStatus: (...args) => this.showStatus(...args),
    });
    this.keys = new KeyEditor({
      onShow: (estimates) => this.showEstimates(estimates), onOpen: () => this.fills.close(), send: (edit) => this.edits.send(edit), showStatus: (...args) => this.showStatus(...args),
    });
    this.scene.afterRender = () => this.placeLabels();
    dialogs.prepareDialogs();
    this.applyTheme(localStorage.getItem("theme"));
    connectControls(this);
    connectCommands(this);
    const animate = (time) => {
      this.playback.advance(time);
      this.scene.renderIfNeeded();
      requestAnimationFrame(animate);
    };
    requestAnimationFrame(animate);
  }

  async start() {
    try {
      await this.fetchSession(firstSession);
      const asked = decodeURIComponent(location.hash.slice(1)), { takes } = this.session;
      const first = takes.find((each) => each.id === asked) ?? takes.find((each) => each.state !== "approved" && !each.error) ?? takes[0];
      await this.openTake(first.id);
    } catch (error) {
      this.cover(error.message);
    }
    this.stream = api.followEvents((event) => this.receive(event), (isConnected) => this.showConnection(isConnected));
  }

  async fetchSession(asked = api.fetchSession()) {
    const session = await asked;
    this.session = { ...session, takes: orderTakes(session.takes) };
  }

  async openTake(id, frame = null) {
    delete document.documentElement.dataset.ready;
    this.isReady = false;
    if (this.samples) this.samples.isCancelled = true;
    this.playback.toggle(false);
    this.closeEstimates();
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
    this.lanes.setTake(take, this.samples);
    this.curves.setTake(take, this.samples, this.lanes.names);
    this.marker = null;
    this.playback.setTake(take);
    this.renderKinds();
    this.renderReview();
    this.offerCharacters(take);
    find("division").value = "one";
    this.scene.setDivision("one");
    const kept = isSame && this.list.rows.some((each) => each.id === this.selectedId) ? this.selectedId : this.list.rows[0]?.id ?? null;
    const entry = this.list.rows.find((each) => each.id === kept);
    const target = frame ?? (entry ? this.middleOf(entry.changes[0]) : 0);
    const load = this.samples.load(target, () => this.drawBlock(take, kept, target));
    this.isComplete = false;
    load.then(() => {
      this.isComplete = this.take === take;
      this.showDecisions(take);
      return this.addOtherPeople(take);
    }).catch((error) => this.showStatus(error.message, true));
    this.showRun(take.run);
    renderDifference(find("difference"), take.difference);
  }

  // Shows the other people of the file in the view.
  async addOtherPeople(take) {
    const folder = take.id.slice(0, take.id.lastIndexOf("/") + 1);
    const others = (this.session?.takes ?? []).filter((each) => each.id !== take.id && each.name === take.name && each.id.startsWith(folder) && !each.error);
    for (const { id } of others) {
      const other = await api.fetchTake(id), samples = new Samples(other);
      await samples.load(this.playback.frame, () => {});
      if (this.take !== take || samples.frameCount !== take.frame_count) return;
      this.scene.addPerson(other, samples);
      this.samples.others.push(samples);
      this.showDecisions(take);
      find("division").querySelector("[value=people]").disabled = false;
    }
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
    this.lanes.update();
    this.playback.moveTo(frame);
    this.scene.frameMarkers(null, FIRST_DIRECTION);
    if (selectedId) this.select(selectedId);
    this.scene.renderIfNeeded();
    document.documentElement.dataset.ready = "1";
  }

  get lastFrame() { return this.take.frame_count - 1; }
  // What the selected row stands for: an event or a change; null without one.
  get entry() { return this.list.rows.find((each) => each.id === this.selectedId) ?? null; }
  // The selected change; of an event that of the marker, at this frame if it has more, else the one that is predicted worst.
  get change() {
    const label = this.take.labels[this.marker], own = this.entry?.changes.filter((each) => each.markers.includes(label)) ?? [];
    const frame = this.playback.frame + this.take.first_frame, here = own.find((each) => each.first <= frame && frame <= each.last);
    return here ?? own[0] ?? this.entry?.changes[0] ?? null;
  }

  toIndex(frame) { return frame - this.take.first_frame; }
  middleOf(change) { return this.toIndex(Math.floor((change.first + change.last) / 2)); }

  // Indices of the labelled markers among some labels.
  findMarkers(labels) { return labels.map((label) => this.take.labels.indexOf(label)).filter((index) => index >= 0); }

  showFrame(frame) {
    if (!this.samples) return;
    this.scene.follow(this.scene.frame, frame, !this.playback.isPlaying && Math.abs(frame - this.scene.frame) > LARGE_STEP);
    const markers = this.marker === null ? [] : [this.marker, ...this.findMarkers(this.entry?.markers ?? [])];
    this.scene.showFrame(frame, markers);
    this.curves.setFrame(frame);
    this.lanes.setFrame(frame);
  }

  showEstimates(estimates) {
    const isFirst = this.fills.isOpen && !this.curves.estimates.length && estimates.length;
    this.curves.setEstimates(estimates);
    this.scene.setEstimates(estimates);
    if (isFirst) this.scene.frameMarkers([this.marker ?? 0]);  // with all of its estimates
  }

  closeEstimates() {
    this.fills.close();
    this.keys.close();
  }

  setKey(frame, axis, value) { if (this.allows("fill")) this.keys.set(this, frame, axis, value); }
  toggleKey() { if (this.marker !== null && this.allows("fill")) this.keys.toggle(this, this.playback.frame); }

  select(id, { keepsFrame = false, marker = null } = {}) {
    this.closeEstimates();
    Object.assign(this, { selectedId: id, correctionIndex: null, marker, other: null, run: null });
    if (id && !this.entry) this.unfoldEventOf(id);
    const { entry, change } = this;
    this.list.selectedId = id;
    this.list.showSelected();
    this.renderDetail();
    this.renderCorrections();
    if (!entry) return;
    const markers = this.findMarkers([...change.markers, ...entry.markers]), interval = [this.toIndex(change.first), this.toIndex(change.last)];
    const ordered = [...new Set([marker ?? markers[0], ...markers])].filter((each) => each !== undefined);
    this.marker = ordered[0] ?? null;
    this.lanes.select(ordered, entry.changes);
    this.curves.showMarkers(entry.changes.length > 1 ? ordered.slice(0, 1) : ordered, interval);
    if (keepsFrame) return this.showFrame(this.playback.frame);
    this.playback.moveTo(this.middleOf(change));
    this.scene.frameMarkers(null);
  }

  // Unfolds the event of a change that has no row yet.
  unfoldEventOf(id) {
    const event = this.events.find((each) => each.changes.some((change) => change.id === id));
    if (event) this.unfolded.add(event.id);
    this.renderReview();
  }

  toggleFold(id = this.selectedId) {
    const row = this.list.rows.find((each) => each.id === id), event = row?.parent ?? (row?.changes.length > 1 ? id : null);
    if (!event) return;
    if (!this.unfolded.delete(event)) this.unfolded.add(event);
    this.renderReview();
    this.select(event, { keepsFrame: true });
  }

  selectNeighbour(steps) {
    const id = this.list.findNeighbour(steps);
    if (id) this.select(id);
  }

  selectInTime(direction) {
    const now = this.playback.frame + this.take.first_frame;
    const ordered = [...this.events].sort((a, b) => direction * (a.first - b.first));
    const next = ordered.find((each) => direction * (Math.floor((each.first + each.last) / 2) - now) > 0);
    if (next) this.select(next.id);
  }

  // Shows the marker of a lane at a frame, and selects what was changed there; adds it to the curves, if asked.
  pickLane(marker, frame, isAdded, isName = false) {
    if (isAdded) return this.curves.toggleMarker(marker);
    if (frame === null && isName && this.run) return this.labelRun(marker);
    if (frame !== null) this.playback.moveTo(frame);
    const number = this.playback.frame + this.take.first_frame, label = this.take.labels[marker];
    const event = this.events.find((each) => each.changes.some((change) => change.markers.includes(label) && change.first <= number && number <= change.last));
    if (event) return this.select(event.id, { keepsFrame: true, marker });
    this.showMarker(marker);
  }

  // Shows a marker without a change.
  showMarker(marker, interval = null) {
    this.closeEstimates();
    Object.assign(this, { marker, selectedId: null, other: null, run: null });
    this.list.selectedId = null;
    this.list.render();
    this.renderDetail();
    this.lanes.select([marker]);
    this.curves.showMarkers([marker], interval);
    this.showFrame(this.playback.frame);
  }

  renderDetail() { renderDetail(find("change-detail"), this.entry, this.change, this.take); }

  // Decides on the changes of the selected row that are not reviewed; on all of them if all are.
  async decide(decision) {
    const { entry } = this;
    if (!entry || !this.allows(decision)) return;
    const next = this.list.findNextOpen(), open = entry.changes.filter((each) => !each.is_reviewed);
    if ((await this.edits.send(new DecideEdit(open.length ? open : entry.changes, decision))) && next && this.selectedId === entry.id) this.select(next);
  }

  async note() {
    const { change } = this;
    if (!change || !this.allows("note")) return;
    const text = await dialogs.askNote(change.id, change.note);
    if (text !== null) await this.edits.send(new NoteEdit(change, text));
  }

  undo() { if (this.allows("undo")) this.edits.send(new UndoEdit()); }
  redo() { if (this.allows("redo")) this.edits.send(new RedoEdit()); }

  // Selects a stretch of frames, and the marker of its lane.
  setStretch(stretch, marker = null) {
    this.stretch = stretch;
    if (marker !== null && marker !== this.marker) this.showMarker(marker);
    this.curves.setStretch(stretch);
    this.lanes.setStretch(stretch);
  }

  toggleZoom() {
    const { frame } = this.playback, entry = this.entry ?? { first: frame + this.take.first_frame, last: frame + this.take.first_frame };
    this.lanes.toggleZoom(this.stretch ?? [this.toIndex(entry.first), this.toIndex(entry.last)]);
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

  frameSelected() { this.scene.frameMarkers(this.entry ? this.findMarkers(this.entry.markers) : this.marker === null ? null : [this.marker]); }

  toggleTakes() {
    find("takes").hidden = !find("takes").hidden;
    this.renderTakes();
  }

  leave() {
    this.closeEstimates();
    Object.assign(this, { other: null, run: null });
    this.setStretch(null);
    find("takes").hidden = true;
    find("difference").hidden = true;
  }

  toggleLayer(name) {
    const box = find(`show-${name}`);
    box.checked = !box.checked;
    box.dispatchEvent(new Event("change"));
  }

  changeDivision() {
    const select = find("division"), options = [...select.options].filter((each) => !each.disabled);
    select.value = options[(options.indexOf(select.selectedOptions[0]) + 1) % options.length].value;
    this.scene.setDivision(select.value);
  }

  switchTheme() { this.applyTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"); }

  // Shows a theme, null for that of the system.
  applyTheme(theme) {
    document.documentElement.dataset.theme = theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    if (theme) localStorage.setItem("theme", theme);
    this.scene.setTheme();
    if (this.samples && this.isReady) this.showFrame(this.playback.frame);
    this.curves.draw();
    this.lanes.draw();
  }

  applyReview(take, review) {
    const { changed = [], ...rest } = review, byId = new Map(changed.map((each) => [each.id, each]));
    Object.assign(take, rest);
    if (byId.size) take.changes = take.changes.map((each) => byId.get(each.id) ?? each);
    if (take !== this.take) return;
    this.renderReview();
    this.showDecisions(take);
    const entry = this.session?.takes.find((each) => each.id === take.id);
    if (entry) Object.assign(entry, { state: take.state, reviewed_count: take.changes.filter((each) => each.is_reviewed).length });
    this.renderTakes();
  }

  // Shows what follows from the decisions and corrections; fills that were taken before are estimated again.
  showDecisions(take) {
    const { samples } = this, draw = () => {
      if (this.take !== take) return;
      samples.showDecisions();
      if (this.isReady) this.showFrame(this.playback.frame);
      this.curves.draw();
      this.lanes.update();
    };
    draw();
    if (this.isComplete) this.fills.restore(take, samples, draw).catch((error) => this.showStatus(error.message, true));
  }

  renderReview() {
    const { take } = this;
    const filters = { kind: find("filter-kind").value, marker: find("filter-marker").value, decision: find("filter-decision").value, order: find("sort").value };
    this.events = listEvents(take, filters);
    const reviewed = take.changes.filter((each) => each.is_reviewed).length;
    find("takes-button").hidden = !this.session?.is_batch;
    this.list.setRows(listRows(this.events, this.unfolded), this.selectedId, take);
    this.limit.render();
    find("count").textContent = `${reviewed} of ${take.changes.length} reviewed`;
    find("count").title = `${take.changes.length} changes in ${take.events.length} events`;
    find("take-state").textContent = take.state === "approved" ? `approved by ${take.approval.name}` : take.state;
    find("take-state").dataset.state = take.state;
    find("approve").textContent = take.state === "approved" ? "Withdraw" : "Approve";
    this.renderDetail();
    this.renderCorrections();
    this.renderAvailability();
  }

  get isRunning() { return this.take.run.state === "running"; }

  // Disables what is refused now, with the reason; so no dialog opens to refuse.
  renderAvailability() {
    const { take } = this, running = this.isRunning ? "The take is being cleaned; wait until that has ended." : "";
    const correcting = take.can_correct ? "" : "Corrections are for takes of markers, not for animations.";
    const obstacles = {
      accept: "", reject: "", keep: "", note: "", approve: running, mark: correcting, swap: correcting, exchange: correcting, fill: running || correcting,
      assign: correcting || (take.unlabelled.length ? "" : "The take has no unlabelled trajectory."),
      undo: take.undo_count ? "" : "There is nothing to undo.", redo: take.redo_count ? "" : "There is nothing to make again.",
      export: running || take.cannot_clean_reason, clean: this.isRunning ? "" : take.cannot_clean_reason,
    };
    for (const [id, obstacle] of Object.entries(obstacles)) {
      const button = find(id);
      button.dataset.title ??= button.title;
      button.disabled = Boolean(obstacle);
      button.title = obstacle || button.dataset.title;
    }
  }

  // Returns whether an action can be carried out, and shows why if it cannot. The actions are named as their buttons.
  allows(id) {
    if (find(id).disabled) this.showStatus(find(id).title, true);
    return !find(id).disabled;
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
      this.showMarker(marker, [this.toIndex(correction.first), this.toIndex(correction.last)]);
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
    if (event.type === "session") this.report(async () => { await this.fetchSession(); this.renderTakes(); });
    if (event.type === "edited" && event.take !== this.take?.id) this.report(() => this.refreshOther(event));
    if (event.take !== this.take?.id) return;
    if (event.type === "edited" && !this.edits.waiting && event.revision !== this.take.revision) this.report(() => this.refreshReview());
    if (event.type === "run") this.showRun(event.run);
  }

  async refreshReview() {
    const { take } = this, fresh = await api.fetchTake(take.id);
    if (fresh.revision !== take.revision) this.applyReview(take, fresh);
  }

  // Shows an edit of another person of the file, which may be an exchange with the one that is shown and end its approval.
  async refreshOther(event) {
    const { take, samples } = this, other = samples.others.find((each) => each.id === event.take);
    if (!other || event.revision === other.take.revision) return;
    const [fresh, { approval, state }] = await Promise.all([event.take, take.id].map(api.fetchTake));
    Object.assign(other.take, fresh);
    this.applyReview(take, { approval, state });
  }

  showRun(run) {
    const wasRunning = this.take.run.state === "running" || run.state === "running" || this.wasRunning;
    this.take.run = run;
    const isRunning = run.state === "running";
    this.limit.render();
    this.renderAvailability();
    find("clean").textContent = isRunning ? "Stop" : "Clean again";
    if (isRunning) this.showStatus(`${this.take.is_preview ? "This is a preview. Cleaning in full" : "Cleaning again"}: ${run.stage}, ${run.percent} % …`);
    find("progress").hidden = !isRunning;
    find("progress").value = run.percent;
    if (run.state === "failed" && wasRunning) this.showStatus(run.message, true);
    if (run.state === "done" && this.wasRunning) {
      const written = this.exported?.length ? ` Written: ${this.exported.join(", ")}.` : "";
      const isPreview = this.take.is_preview;
      this.exported = null;
      this.report(async () => { await this.openTake(this.take.id, this.playback.frame); this.showStatus(`Cleaned ${isPreview ? "in full" : "again"}.${written}`); });
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
    this.stream?.close();
    find("cover").textContent = text;
    find("cover").hidden = false;
  }
}

Object.assign(App.prototype, correctionActions, outputActions, labelCorrection, labelPlacement);

const app = new App();
window.review = { app, getFrameRate: () => app.playback.frameRate, getState: () => ({ frame: app.playback.frame, selected: app.selectedId, take: app.take, isComplete: app.isComplete }) };
app.start();

// The commands of the page: one list for the keys, the buttons, the help, and the palette in which they are found by a word.

import * as api from "./api.js";
import { isDialogOpen, showModal } from "./dialogs.js";

const FRONT = [0, 0.1, 1], SIDE = [1, 0.1, 0], TOP = [0, 1, 0.001];  // from the performer: left, up, front
export const LARGE_STEP = 10;  // frames
const find = (id) => document.getElementById(id);
const isTyping = (target) => target.matches("input:not([type=checkbox]):not([type=range]), textarea, select");

// Returns the commands: the keys, as `nameKey` names them; what is shown of them; a text; what it does; and the id of its button.
function listCommands(app) {
  const { playback, scene } = app, look = (direction) => scene.frameMarkers(null, direction), step = (frames) => playback.moveTo(playback.frame + frames);
  return [
    [["a"], "A", "accept the event or change, and go on to the next that is not reviewed", () => app.decide("accept"), "accept"],
    [["r"], "R", "reject: the change is not made", () => app.decide("reject"), "reject"],
    [["k"], "K", "keep as measured: there is no fault", () => app.decide("keep"), "keep"],
    [["Shift+A"], "Shift-A", "accept all that is predicted within the limit", () => app.limit.accept(), "accept-within"],
    [[","], ",", "lower the limit", () => app.limit.change(-1)],
    [["."], ".", "raise the limit", () => app.limit.change(1)],
    [["m"], "M", "note in words", () => app.note(), "note"],
    [["Ctrl+z"], "Ctrl-Z", "undo the last edit", () => app.undo(), "undo"],
    [["Ctrl+y", "Ctrl+Z"], "Ctrl-Y", "make again what was undone", () => app.redo(), "redo"],
    [["ArrowDown"], "↓", "next row in the list", () => app.selectNeighbour(1)],
    [["ArrowUp"], "↑", "previous row in the list", () => app.selectNeighbour(-1)],
    [["Enter"], "Enter", "fold or unfold the event; set the points by hand, if there are any", () => (app.keys.isOpen ? app.keys.apply() : app.toggleFold())],
    [["PageDown"], "Page down", "next event in time", () => app.selectInTime(1), "next-change"],
    [["PageUp"], "Page up", "previous event in time", () => app.selectInTime(-1), "previous-change"],
    [[" "], "Space", "play or pause", () => playback.toggle(), "play"],
    [["ArrowRight"], "→", "next frame", () => step(1)],
    [["ArrowLeft"], "←", "previous frame", () => step(-1)],
    [["Shift+ArrowRight"], "Shift-→", "ten frames on", () => step(LARGE_STEP)],
    [["Shift+ArrowLeft"], "Shift-←", "ten frames back", () => step(-LARGE_STEP)],
    [["Home"], "Home", "first frame", () => playback.moveTo(0)],
    [["End"], "End", "last frame", () => playback.moveTo(app.lastFrame)],
    [["+", "="], "+", "faster", () => playback.changeSpeed(1)],
    [["-"], "−", "slower", () => playback.changeSpeed(-1)],
    [["["], "[", "start of a stretch at this frame; or drag over the lanes, Shift-drag over the curves", () => app.setStretchEnd("first")],
    [["]"], "]", "end of a stretch at this frame", () => app.setStretchEnd("last")],
    [["Escape"], "Escape", "no stretch; close lists", () => app.leave()],
    [["w"], "W", "mark the stretch as wrong", () => app.mark("wrong"), "mark"],
    [["x"], "X", "mark the stretch as missing", () => app.mark("missing")],
    [["s"], "S", "swap two labels; click a marker in the view and Ctrl-click another to swap them up to the next break of either", () => app.swap(), "swap"],
    [["Shift+S"], "Shift-S", "exchange (swap) the labels of left and right, or of two people, in the stretch or the whole take", () => app.exchange(), "exchange"],
    [["Tab"], "Tab", "next unlabelled trajectory; a click on the name of a marker labels it", () => app.pickNextRun()],
    [["u"], "U", "assign an unlabelled trajectory", () => app.assign(), "assign"],
    [["g"], "G", "see all estimates of a gap or stretch, of which a number takes one", () => app.requestFill(), "fill"],
    [["j"], "J", "set a point of the marker by hand at this frame, or remove it; or Ctrl-click and Ctrl-drag on its curves", () => app.toggleKey()],
    [["Shift+ArrowUp"], "Shift-↑", "move the point of this frame by 1 mm", () => app.keys.move(app, playback.frame, 0.001)],
    [["Shift+ArrowDown"], "Shift-↓", "move it back", () => app.keys.move(app, playback.frame, -0.001)],
    [["y"], "Y", "move points along another axis", () => app.keys.nextAxis()],
    [["Delete"], "Delete", "remove the selected correction", () => app.removeCorrection()],
    [["z"], "Z", "zoom the lanes to the selection, or to the whole take; the wheel zooms, with Shift it moves, as does Alt-drag", () => app.toggleZoom(), "lanes-zoom"],
    [["i"], "I", "curves of position, speed, distance to a marker or the body, rotation of a joint; Ctrl-click on a lane adds its marker, Ctrl-wheel enlarges", () => app.curves.changeQuantity()],
    [["c"], "C", "clean again with the decisions, or stop it", () => (app.isRunning ? app.report(() => api.cancelCleaning(app.take.id)) : app.clean()), "clean"],
    [["e"], "E", "export further files", () => app.export(), "export"],
    [["p"], "P", "approve, or withdraw the approval", () => app.approve(), "approve"],
    [["t"], "T", "list of takes", () => app.toggleTakes(), "takes-button"],
    [["n"], "N", "next take that is not approved", () => app.openNextTake()],
    [["1"], "1", "view from in front of the performer", () => look(FRONT), "view-front"],
    [["2"], "2", "view from the performer's left side", () => look(SIDE), "view-side"],
    [["3"], "3", "view from above", () => look(TOP), "view-top"],
    [["4"], "4", "follow the performer, or keep the view where it is", () => app.toggleLayer("follow")],
    [["5"], "5", "one picture, before and after beside each other, or each person", () => app.changeDivision()],
    [["6"], "6", "show or hide the ghost of before: all markers and the sticks between them", () => app.toggleLayer("ghost")],
    [["7"], "7", "show or hide the body", () => app.toggleLayer("body")],
    [["8"], "8", "show or hide sticks between markers", () => app.toggleLayer("sticks")],
    [["9"], "9", "show or hide bones", () => app.toggleLayer("skeleton")],
    [[], "1–7", "take an estimate, while those of a gap are shown", () => app.requestFill()],
    [["0"], "0", "the whole body", () => look(null), "view-all"],
    [["f"], "F", "the selected markers", () => app.frameSelected()],
    [["b"], "B", "show or hide markers before", () => app.toggleLayer("before")],
    [["v"], "V", "show or hide markers after", () => app.toggleLayer("after")],
    [["l"], "L", "show or hide labels", () => app.toggleLayer("labels")],
    [["o"], "O", "show or hide the path of the marker", () => app.toggleLayer("trails")],
    [["d"], "D", "dark or light", () => app.switchTheme(), "theme"],
    [["Ctrl+k"], "Ctrl-K", "find a command", () => openPalette(), "palette-button"],
    [["?", "h"], "?", "all keys", () => showModal(find("dialog-help")), "help"],
    [["q"], "Q", "end the review", () => app.end(), "end"],
  ].map(([keys, shown, text, run, button]) => ({ keys, shown, text, run, button }));
}

// Name of a pressed key; that of a letter is small, unless Shift makes it another command.
function nameKey(event) {
  const isLetter = event.key.length === 1 && event.key.toLowerCase() !== event.key.toUpperCase();
  if (event.ctrlKey || event.metaKey) return `Ctrl+${event.shiftKey ? event.key.toUpperCase() : event.key.toLowerCase()}`;
  if (event.shiftKey && (["A", "S"].includes(event.key) || event.key.startsWith("Arrow"))) return `Shift+${event.key}`;
  return isLetter ? event.key.toLowerCase() : event.key;
}

// Connects the commands with keys, buttons, help and palette.
export function connectCommands(app) {
  const commands = listCommands(app), byKey = new Map(commands.flatMap((each) => each.keys.map((key) => [key, each])));
  const needsNoTake = ["help", "end", "palette-button", "theme"];
  for (const { button, run } of commands) {
    if (button) find(button).addEventListener("click", (event) => {
      if (event.detail) event.currentTarget.blur();  // after a click with the pointer, Space plays
      if (app.take || needsNoTake.includes(button)) run();
    });
  }
  document.addEventListener("change", ({ target }) => { if (target.matches("select") && !isDialogOpen()) target.blur(); });
  document.addEventListener("keydown", (event) => {
    if (isDialogOpen() || event.altKey) return;
    const key = nameKey(event), command = byKey.get(key);
    if (!command || !app.isReady || (isTyping(event.target) && !["Escape", "Ctrl+k"].includes(key))) return;
    if ((key === " " || key === "Enter") && event.target.matches("button")) return;
    if (key === "Tab" && (event.target !== document.body || !app.take.unlabelled.length)) return;  // it goes on to the next control
    if (event.target.id === "limit" && key.startsWith("Arrow")) return;
    event.preventDefault();
    if (isTyping(event.target)) event.target.blur();
    if (!/^[1-7]$/.test(key) || !app.fills.choose(Number(key))) command.run();
  });
  find("help-list").replaceChildren(...commands.map((each) => buildItem(each, false)));
  find("dialog-help").addEventListener("click", () => find("dialog-help").close());
  connectPalette(commands);
}

function openPalette() {
  find("palette-text").value = "";
  find("palette-text").dispatchEvent(new Event("input"));
  showModal(find("dialog-palette"));
}

// Lists the commands of which text or keys have all words that are entered; those that are refused now say why.
function connectPalette(commands) {
  const input = find("palette-text"), list = find("palette-list"), dialog = find("dialog-palette");
  let found = [], at = 0;
  const run = (command) => {
    dialog.close();
    if (!command || (command.button && find(command.button).disabled)) return;
    command.run();
  };
  const render = () => {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    found = commands.filter((each) => words.every((word) => `${each.text} ${each.shown}`.toLowerCase().includes(word)));
    at = Math.min(Math.max(at, 0), Math.max(0, found.length - 1));
    list.replaceChildren(...found.map((each, n) => buildItem(each, n === at, () => run(each))));
    list.children[at]?.scrollIntoView({ block: "nearest" });
  };
  input.addEventListener("input", () => { at = 0; render(); });
  dialog.addEventListener("keydown", (event) => {
    if (!["ArrowDown", "ArrowUp", "Enter"].includes(event.key)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (event.key === "Enter") return run(found[at]);
    at += event.key === "ArrowDown" ? 1 : -1;
    render();
  });
}

function buildItem({ shown, text, button }, isSelected, run = null) {
  const item = document.createElement("li"), key = document.createElement("kbd");
  const obstacle = run && button && find(button).disabled ? find(button).title : "";
  key.textContent = shown;
  item.append(key, ` ${text}${obstacle ? ` – ${obstacle}` : ""}`);
  if (!run) return item;
  item.setAttribute("role", "option");
  item.setAttribute("aria-selected", String(isSelected));
  item.setAttribute("aria-disabled", String(Boolean(obstacle)));
  item.addEventListener("click", run);
  return item;
}

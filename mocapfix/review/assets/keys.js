/** Keys, what they do, and how the help names them. */

import { isDialogOpen } from "./dialogs.js";
import { build } from "./elements.js";

/** [keys as shown, text, {key: [action, argument]}] */
const GROUPS = [
  ["Changes", [
    ["↑ ↓", "previous and next in the list", { ArrowUp: ["selectNeighbour", -1], ArrowDown: ["selectNeighbour", 1] }],
    ["Page up, Page down", "previous and next in time", { PageUp: ["selectInTime", -1], PageDown: ["selectInTime", 1] }],
    ["A", "accept", { a: ["decide", "accept"] }],
    ["R", "reject: do not make the change", { r: ["decide", "reject"] }],
    ["K", "keep the samples as measured", { k: ["decide", "keep"] }],
    ["Shift-A", "accept all of this kind", { "Shift+a": ["acceptKind"] }],
    ["M", "note in words", { m: ["writeNote"] }],
    ["Ctrl-Z", "undo the last edit", { "Control+z": ["undo"] }],
  ]],
  ["Your corrections", [
    ["[ ]", "stretch: starts, ends at this frame", { "[": ["startStretch"], "]": ["endStretch"] }],
    ["Shift-drag", "select a stretch in the curves", {}],
    ["W", "mark a stretch as wrong", { w: ["mark", "wrong"] }],
    ["X", "mark a stretch as missing", { x: ["mark", "missing"] }],
    ["S", "swap two labels", { s: ["swap"] }],
    ["U", "assign an unlabelled trajectory", { u: ["assign"] }],
    ["G", "set how a gap is filled", { g: ["setFill"] }],
    ["Shift-↑ Shift-↓", "select a correction", { "Shift+arrowup": ["selectCorrectionNeighbour", -1], "Shift+arrowdown": ["selectCorrectionNeighbour", 1] }],
    ["Delete", "remove the selected correction", { Delete: ["removeCorrection"] }],
  ]],
  ["Playback", [
    ["Space", "play or pause", { " ": ["togglePlayback"] }],
    ["← →", "one frame; with Shift ten", {
      ArrowLeft: ["step", -1], ArrowRight: ["step", 1], "Shift+arrowleft": ["step", -10], "Shift+arrowright": ["step", 10] }],
    ["Home, End", "first and last frame", { Home: ["step", -Infinity], End: ["step", Infinity] }],
    ["+ -", "faster, slower", { "+": ["changeSpeed", 1], "=": ["changeSpeed", 1], "-": ["changeSpeed", -1] }],
  ]],
  ["View", [
    ["1 2 3", "front, side, top", { 1: ["setView", "front"], 2: ["setView", "side"], 3: ["setView", "top"] }],
    ["F", "the selected markers", { f: ["setView", "selected"] }],
    ["0", "the whole take", { 0: ["setView", "all"] }],
    ["B D V O L", "before, after, skeleton, trails, labels", {
      b: ["toggleLayer", "before"], d: ["toggleLayer", "after"], v: ["toggleLayer", "skeleton"],
      o: ["toggleLayer", "trails"], l: ["toggleLayer", "labels"] }],
    [", .", "previous and next marker in the curves", { ",": ["stepMarker", -1], ".": ["stepMarker", 1] }],
    ["Y", "dark or light", { y: ["switchTheme"] }],
  ]],
  ["Take", [
    ["C", "clean again", { c: ["clean"] }],
    ["I", "what differs from before", { i: ["showDifference"] }],
    ["E", "export", { e: ["exportFiles"] }],
    ["P", "approve, or withdraw the approval", { p: ["approve"] }],
    ["T", "list of takes", { t: ["toggleTakes"] }],
    ["N", "next take that is not approved", { n: ["openNextTake"] }],
    ["Q", "end the review", { q: ["end"] }],
    ["? or H", "this list", { "?": ["showHelp"], h: ["showHelp"] }],
    ["Esc", "close, or clear the stretch", { Escape: ["leave"] }],
  ]],
];

const ACTIONS = Object.assign({}, ...GROUPS.flatMap(([, keys]) => keys.map(([, , actions]) => actions)));
const REPEATED = new Set(["selectNeighbour", "selectInTime", "step", "changeSpeed", "selectCorrectionNeighbour", "stepMarker", "undo"]);

export function listenForKeys(app) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || isDialogOpen() || event.isComposing) return;
    if (isTyping(event.target)) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    if (isUsed(event)) return;
    const entry = ACTIONS[nameKey(event)];
    if (!entry || app.isClosed || app.connection.isLost) return;
    const [action, argument] = entry;
    event.preventDefault();
    if (event.repeat && !REPEATED.has(action)) return;
    app.run(action, argument);
  });
}

function nameKey(event) {
  if (event.altKey) return "";
  const letter = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (event.ctrlKey || event.metaKey) return letter === "z" && !event.shiftKey ? "Control+z" : "";
  const isNamed = letter.length > 1 || (letter >= "a" && letter <= "z");
  return event.shiftKey && isNamed ? `Shift+${letter.toLowerCase()}` : letter;
}

function isTyping(target) {
  if (target.isContentEditable || ["TEXTAREA", "SELECT"].includes(target.tagName)) return true;
  return target.tagName === "INPUT" && !["range", "checkbox", "button"].includes(target.type);
}

/** Whether an element with the focus uses the key itself: buttons and check boxes Space, buttons Enter. */
function isUsed(event) {
  const isButton = event.target.tagName === "BUTTON", isCheck = event.target.type === "checkbox";
  return (event.key === " " && (isButton || isCheck)) || (event.key === "Enter" && isButton);
}

export function listKeys(element) {
  element.replaceChildren(...GROUPS.map(([title, keys]) => build("section", {}, build("h3", { textContent: title }),
    build("dl", {}, ...keys.flatMap(([names, text]) => [build("dt", { textContent: names }), build("dd", { textContent: text })])))));
}

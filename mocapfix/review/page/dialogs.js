// The dialogs of the page. Each function shows one and returns a promise of what was entered, null if it was cancelled.

const find = (id) => document.getElementById(id);

const KEYS = [
  ["A · R · K", "accept · reject · keep as measured the event or change, and go on to the next that is not reviewed"],
  ["Shift-A", "accept all that is predicted within the limit"], [", and .", "a lower, a higher limit"],
  ["Enter", "fold or unfold an event"], ["M", "note in words"], ["Ctrl-Z · Ctrl-Y", "undo the last edit · make it again"],
  ["↑ ↓", "previous and next row in the list"], ["Page up, Page down", "previous and next event in time"],
  ["Z", "the lanes around what is selected, or of the whole take; the wheel zooms, with Shift it moves, Alt-drag moves"],
  ["I", "curves of position, speed, distance; Ctrl-click on a lane adds its marker"],
  ["← →", "one frame; with Shift ten"], ["Home, End", "first and last frame"], ["Space", "play or pause"], ["+ −", "faster, slower"],
  ["[ and ]", "start and end of a stretch at this frame; or drag over the lanes, Shift-drag over the curves; Escape ends it"],
  ["W · X", "mark the stretch as wrong · as missing"], ["S", "swap two labels"], ["U", "assign an unlabelled trajectory"],
  ["G", "how a gap is filled"], ["Delete", "remove the selected correction"],
  ["C", "clean again with the decisions"], ["E", "export further files"], ["P", "approve, or withdraw the approval"],
  ["T · N", "list of takes · next take that is not approved"],
  ["1 2 3 · F · 0", "front, side, top · frame the markers · whole take"],
  ["B · V · L · O", "show or hide: before · after · labels · trails"], ["D", "dark or light"],
  ["? or H", "this help"], ["Q", "end the review"],
];

function show(dialog) {
  return new Promise((resolve) => {
    dialog.returnValue = "";
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
    dialog.showModal();
    (dialog.querySelector("select, input, textarea") ?? dialog.querySelector("button.primary"))?.focus();
  });
}

export function prepareDialogs() {
  for (const actions of document.querySelectorAll("dialog .actions")) {
    const cancel = Object.assign(document.createElement("button"), { textContent: "Cancel", value: "", type: "button" });
    cancel.addEventListener("click", () => cancel.closest("dialog").close(""));
    const accept = Object.assign(document.createElement("button"), { textContent: "OK", value: "yes", type: "submit", className: "primary" });
    actions.replaceChildren(cancel, accept);
  }
  const table = document.createElement("table");
  for (const cells of KEYS) {
    const row = table.insertRow();
    for (const text of cells) row.insertCell().textContent = text;
  }
  const title = Object.assign(document.createElement("h3"), { textContent: "Keys" });
  find("dialog-help").replaceChildren(title, table);
  find("dialog-help").addEventListener("click", () => find("dialog-help").close());
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.addEventListener("keydown", (event) => {  // Enter confirms, also in a list
      if (event.key !== "Enter" || event.shiftKey || event.target.matches("button")) return;
      event.preventDefault();
      dialog.close("yes");
    });
  }
}

export const isDialogOpen = () => document.querySelector("dialog[open]") !== null;
export const showHelp = () => show(find("dialog-help"));

function fillOptions(select, names, chosen) {
  select.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
}

function writeInterval(name, [first, last]) {
  find(`${name}-first`).value = first;
  find(`${name}-last`).value = last;
}

const readInterval = (name) => ({ first: Number(find(`${name}-first`).value), last: Number(find(`${name}-last`).value) });

export async function askNote(name, text) {
  find("note-name").textContent = name;
  find("note-text").value = text;
  return (await show(find("dialog-note"))) ? find("note-text").value : null;
}

export async function askMark(labels, marker, interval, kind) {
  fillOptions(find("mark-marker"), labels, marker);
  writeInterval("mark", interval);
  find("mark-kind").value = kind;
  if (!(await show(find("dialog-mark")))) return null;
  return { kind: find("mark-kind").value, markers: [find("mark-marker").value], ...readInterval("mark") };
}

export async function askSwap(labels, markers, interval) {
  fillOptions(find("swap-one"), labels, markers[0]);
  fillOptions(find("swap-other"), labels, markers[1] ?? labels.find((label) => label !== markers[0]));
  writeInterval("swap", interval);
  if (!(await show(find("dialog-swap")))) return null;
  return { kind: "swap", markers: [find("swap-one").value, find("swap-other").value], ...readInterval("swap") };
}

export async function askAssign(labels, trajectories, marker, trajectory, interval) {
  fillOptions(find("assign-marker"), labels, marker);
  fillOptions(find("assign-trajectory"), trajectories, trajectory);
  writeInterval("assign", interval);
  if (!(await show(find("dialog-assign")))) return null;
  return { kind: "assign", markers: [find("assign-marker").value, find("assign-trajectory").value], ...readInterval("assign") };
}

export async function askFill(labels, marker, interval) {
  fillOptions(find("fill-marker"), labels, marker);
  writeInterval("fill", interval);
  if (!(await show(find("dialog-fill")))) return null;
  return { kind: "fill", markers: [find("fill-marker").value], method: find("fill-method").value, ...readInterval("fill") };
}

export async function askExport({ formats, rigs, written }) {
  for (const [id, name, values] of [["export-formats", "format", formats], ["export-rigs", "rig", rigs]]) {
    const boxes = values.map((value) => {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", name, value, checked: written.includes(value) });
      const label = document.createElement("label");
      label.append(box, ` ${value}`);
      return label;
    });
    find(id).replaceChildren(find(id).querySelector("legend"), ...boxes);
  }
  if (!(await show(find("dialog-export")))) return null;
  const checked = (name) => [...document.querySelectorAll(`#dialog-export input[name="${name}"]:checked`)].map((box) => box.value);
  return { formats: checked("format"), rigs: checked("rig") };
}

export async function askName() {
  find("approve-name").value = localStorage.getItem("approve-name") ?? "";
  if (!(await show(find("dialog-approve")))) return null;
  localStorage.setItem("approve-name", find("approve-name").value);
  return find("approve-name").value;
}

export async function confirmAction(title, text) {
  find("confirm-title").textContent = title;
  find("confirm-text").textContent = text;
  return show(find("dialog-confirm"));
}

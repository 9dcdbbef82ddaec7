// The dialogs of the page. Each function shows one and returns a promise of what was entered, null if it was cancelled.

const find = (id) => document.getElementById(id);

// Shows a dialog; resolves to whether it was confirmed.
export function showModal(dialog) {
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
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.addEventListener("keydown", (event) => {  // Enter confirms, also in a list
      if (event.key !== "Enter" || event.shiftKey || event.target.matches("button")) return;
      event.preventDefault();
      dialog.close("yes");
    });
  }
}

export const isDialogOpen = () => document.querySelector("dialog[open]") !== null;

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
  return (await showModal(find("dialog-note"))) ? find("note-text").value : null;
}

export async function askMark(labels, marker, interval, kind) {
  fillOptions(find("mark-marker"), labels, marker);
  writeInterval("mark", interval);
  find("mark-kind").value = kind;
  if (!(await showModal(find("dialog-mark")))) return null;
  return { kind: find("mark-kind").value, markers: [find("mark-marker").value], ...readInterval("mark") };
}

export async function askSwap(labels, markers, interval) {
  fillOptions(find("swap-one"), labels, markers[0]);
  fillOptions(find("swap-other"), labels, markers[1] ?? labels.find((label) => label !== markers[0]));
  writeInterval("swap", interval);
  if (!(await showModal(find("dialog-swap")))) return null;
  return { kind: "swap", markers: [find("swap-one").value, find("swap-other").value], ...readInterval("swap") };
}

export async function askAssign(labels, trajectories, marker, trajectory, interval) {
  fillOptions(find("assign-marker"), labels, marker);
  fillOptions(find("assign-trajectory"), trajectories, trajectory);
  writeInterval("assign", interval);
  if (!(await showModal(find("dialog-assign")))) return null;
  return { kind: "assign", markers: [find("assign-marker").value, find("assign-trajectory").value], ...readInterval("assign") };
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
  if (!(await showModal(find("dialog-export")))) return null;
  const checked = (name) => [...document.querySelectorAll(`#dialog-export input[name="${name}"]:checked`)].map((box) => box.value);
  return { formats: checked("format"), rigs: checked("rig") };
}

export async function askName() {
  find("approve-name").value = localStorage.getItem("approve-name") ?? "";
  if (!(await showModal(find("dialog-approve")))) return null;
  localStorage.setItem("approve-name", find("approve-name").value);
  return find("approve-name").value;
}

export async function confirmAction(title, text) {
  find("confirm-title").textContent = title;
  find("confirm-text").textContent = text;
  return showModal(find("dialog-confirm"));
}

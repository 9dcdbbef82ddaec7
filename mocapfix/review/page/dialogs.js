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
    dialog.addEventListener("keydown", (event) => {  // Enter confirms, also in a list, what the browser finds valid
      if (event.key !== "Enter" || event.shiftKey || event.target.matches("button")) return;
      event.preventDefault();
      (dialog.querySelector("button.primary") ?? dialog).click();
    });
  }
}

export const isDialogOpen = () => document.querySelector("dialog[open]") !== null;

function fillOptions(select, names, chosen) {
  select.replaceChildren(...names.map((name) => new Option(name, name, false, name === chosen)));
}

function writeInterval(name, [first, last]) {
  const { min, max } = find("frame");  // of the take
  Object.assign(find(`${name}-first`), { value: first, min, max, required: true });
  Object.assign(find(`${name}-last`), { value: last, min, max, required: true });
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

export async function askSwap(labels, others, markers, interval) {
  fillOptions(find("swap-one"), labels, markers[0]);
  fillOptions(find("swap-other"), [...labels, ...others], markers[1] ?? labels.find((label) => label !== markers[0]));
  writeInterval("swap", interval);
  if (!(await showModal(find("dialog-swap")))) return null;
  return { kind: "swap", markers: [find("swap-one").value, find("swap-other").value], ...readInterval("swap") };
}

// Resolves to the swaps of one of some choices, each a name and pairs of labels.
export async function askExchange(choices, interval) {
  find("exchange-what").replaceChildren(...choices.map(([name, pairs], n) => new Option(`${name}: ${pairs.length} pairs, such as ${pairs[0].join(" and ")}`, n)));
  writeInterval("exchange", interval);
  if (!(await showModal(find("dialog-exchange")))) return null;
  return choices[Number(find("exchange-what").value)][1].map((markers) => ({ kind: "swap", markers, ...readInterval("exchange") }));
}

export async function askAssign(labels, trajectories, marker, trajectory, interval) {
  fillOptions(find("assign-marker"), labels, marker);
  fillOptions(find("assign-trajectory"), trajectories, trajectory);
  writeInterval("assign", interval);
  if (!(await showModal(find("dialog-assign")))) return null;
  return { kind: "assign", markers: [find("assign-marker").value, find("assign-trajectory").value], ...readInterval("assign") };
}

// Resolves to the options of an export: formats, programs and characters that fit the take, rate, and frames of the character.
export async function askExport(take) {
  const { choices, written, output_rate_hz: rate, trim } = take.export, lastFrame = take.first_frame + take.frame_count - 1;
  for (const [name, values] of Object.entries(choices)) {
    const field = find(`export-${name}`), boxes = values.map((value) => {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", name, value, checked: written[name].includes(value) });
      const label = document.createElement("label");
      label.append(box, ` ${value}`);
      return label;
    });
    field.replaceChildren(field.querySelector("legend"), ...boxes);
    field.hidden = !values.length;
  }
  const hasMotion = choices.characters.length > 0, ends = [find("export-first"), find("export-last")];
  find("export-motion").hidden = !hasMotion;
  find("export-rate").value = rate ?? "";
  find("export-rate").placeholder = Number(take.rate.toFixed(3));
  writeInterval("export", trim ?? [take.first_frame, lastFrame]);
  const checked = (name) => [...document.querySelectorAll(`#dialog-export input[name="${name}"]:checked`)].map((box) => box.value);
  const allowTrim = () => { for (const end of ends) end.disabled = !checked("characters").length; };
  find("export-characters").onchange = allowTrim;
  allowTrim();
  if (!(await showModal(find("dialog-export")))) return null;
  const chosen = Object.fromEntries(Object.keys(choices).map((name) => [name, checked(name).join(",")]));
  const { first, last } = readInterval("export"), isWhole = first <= take.first_frame && last >= lastFrame;
  if (hasMotion) Object.assign(chosen, { output_rate_hz: find("export-rate").value, trim: ends[0].disabled || isWhole ? "" : `${first}:${last}` });
  return Object.fromEntries(Object.entries(chosen).filter(([name, text]) => text || name === "output_rate_hz" || name === "trim"));
}

export async function askName(reviewer) {
  find("approve-name").value = localStorage.getItem("approve-name") ?? reviewer;
  if (!(await showModal(find("dialog-approve")))) return null;
  localStorage.setItem("approve-name", find("approve-name").value);
  return find("approve-name").value;
}

export async function confirmAction(title, text) {
  find("confirm-title").textContent = title;
  find("confirm-text").textContent = text;
  return showModal(find("dialog-confirm"));
}

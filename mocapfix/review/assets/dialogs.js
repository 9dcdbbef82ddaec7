/** Dialogs: they are filled, opened, confirmed with Enter and closed with Escape. */

import { build, find, fillOptions } from "./elements.js";

/** Open a dialog. `submit` returns a sentence if its fields cannot be used, else nothing. */
export function openDialog(id, { title, about, button = "OK", submit }) {
  const dialog = find(id), form = dialog.querySelector("form");
  const heading = dialog.querySelector("h2");
  if (title) heading.textContent = title;
  const text = dialog.querySelector("p.about");
  if (text) {
    text.textContent = about ?? "";
    text.hidden = !about;
  }
  form.noValidate = true; // the sentences of the page say more
  if (!form.querySelector(".problem")) form.append(build("p", { className: "problem", role: "alert", hidden: true }));
  const problem = form.querySelector(".problem");
  problem.hidden = true;
  if (!form.querySelector(".actions")) {
    form.append(build("p", { className: "actions" },
      build("button", { type: "submit" }),
      build("button", { type: "button", textContent: "Cancel", onclick: () => dialog.close() })));
  }
  const confirm = form.querySelector(".actions button[type=submit]");
  confirm.textContent = button;
  form.onsubmit = (event) => {
    event.preventDefault();
    const sentence = submit?.();
    problem.textContent = sentence ?? "";
    problem.hidden = !sentence;
    if (!sentence) dialog.close();
  };
  dialog.onkeydown = (event) => {
    if (event.key !== "Enter" || event.shiftKey || event.isComposing || event.target.tagName === "BUTTON") return;
    event.preventDefault();
    form.requestSubmit();
  };
  dialog.showModal();
  const field = form.querySelector("textarea, input:not([type=checkbox]), select");
  (field ?? confirm).focus();
  if (field?.select) field.select();
}

/** Ask before something is done. */
export function confirmAction(question, button, act) {
  openDialog("dialog-confirm", { title: question, button, submit: () => { act(); } });
}

export const isDialogOpen = () => document.querySelector("dialog[open]") !== null;

/** Fill the fields of the frames of a dialog, in the numbers of the file. */
export function fillFrames(name, take, [first, last]) {
  for (const [end, frame] of [["first", first], ["last", last]]) {
    const input = find(`${name}-${end}`);
    input.min = take.first_frame;
    input.max = take.first_frame + take.frame_count - 1;
    input.value = frame + take.first_frame;
  }
}

/** Read the fields of the frames: {first, last} or {problem}. */
export function readFrames(name, take) {
  const [first, last] = ["first", "last"].map((end) => Number(find(`${name}-${end}`).value));
  const end = take.first_frame + take.frame_count - 1;
  if (!Number.isInteger(first) || !Number.isInteger(last)) return { problem: "Frames are whole numbers." };
  if (first > last) return { problem: "The first frame is after the last." };
  if (first < take.first_frame || last > end) return { problem: `The take has the frames ${take.first_frame} to ${end}.` };
  return { first, last };
}

export function fillMarkers(id, labels, selected) {
  fillOptions(find(id), labels.map((label) => [label, label]), selected);
}

/** Fill a group of check boxes. */
export function fillChecks(fieldset, name, values) {
  const boxes = values.map((value) => build("label", {}, build("input", { type: "checkbox", name, value }), ` ${value}`));
  fieldset.replaceChildren(fieldset.querySelector("legend"), ...boxes);
  fieldset.hidden = !values.length;
}

export function readChecks(fieldset) {
  return [...fieldset.querySelectorAll("input:checked")].map((input) => input.value);
}

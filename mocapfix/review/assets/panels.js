/** Panels beside the main view: corrections, takes, and what differs from the cleaning before. */

import { build, count, find, formatMm } from "./elements.js";

const KINDS = { wrong: "wrong", missing: "missing", swap: "swap", assign: "assign", fill: "fill" };
const MAX_LISTED = 60;

export function renderCorrections(app) {
  const rows = app.take.corrections.map((correction, index) => {
    const { kind, markers, first, last, method, note } = correction;
    const text = kind === "assign" ? `${markers[1]} is ${markers[0]}` : markers.join(" and ");
    return build("div", {
      className: "row", role: "option", ariaSelected: String(index === app.correction), data: { index: String(index), kind },
      title: note ?? "", onclick: () => app.selectCorrection(index),
    },
    build("span", { className: "kind", textContent: KINDS[kind] ?? kind }),
    build("span", { className: "markers", textContent: text }),
    build("span", { className: "frames", textContent: `${first}–${last}` }),
    build("span", { className: "method", textContent: method ?? "" }),
    build("button", { type: "button", title: "Remove (Delete)", textContent: "Remove", onclick: (event) => {
      event.stopPropagation();
      app.run("removeCorrection", index);
    } }));
  });
  const empty = build("p", { className: "empty", textContent: "None yet. Select a stretch with [ and ], then W, X, S, U or G." });
  find("corrections").replaceChildren(...(rows.length ? rows : [empty]));
  find("corrections").querySelector('[aria-selected="true"]')?.scrollIntoView({ block: "nearest" });
}

export function renderNotes(take) {
  const list = find("notes");
  list.replaceChildren(...take.notes.map((textContent) => build("li", { textContent })));
  list.hidden = !take.notes.length;
}

export function renderTakes(app) {
  const { takes, folder } = app.session;
  const rows = takes.map((take) => {
    const isOpen = take.id === app.take?.id;
    const state = take.state === "approved" && take.approved_by ? `approved by ${take.approved_by}` : take.state;
    const row = build("button", {
      type: "button", className: "row", data: { id: take.id, state: take.state },
      onclick: () => app.run("openListedTake", take.id),
    },
    build("span", { className: "name", textContent: take.subject ? `${take.name}, ${take.subject}` : take.name }),
    build("span", { className: "state", textContent: state }),
    build("span", { className: "progress", textContent: take.error || `${take.reviewed_count} of ${take.change_count} reviewed` }),
    build("span", { className: "error", textContent: take.worst_mm === null ? "" : formatMm(take.worst_mm), title: "Largest predicted error" }));
    if (isOpen) row.setAttribute("aria-current", "true");
    return row;
  });
  const approved = takes.filter(({ state }) => state === "approved").length;
  find("takes").replaceChildren(
    build("h2", { textContent: folder }),
    build("p", { className: "remark", textContent: `${approved} of ${count(takes.length, "take")} approved. N opens the next that is not.` }),
    build("div", { className: "rows" }, ...rows));
  return rows.find((row) => row.hasAttribute("aria-current")) ?? rows[0];
}

/** Move the focus in the list of takes with the arrow keys. */
export function listenInTakes() {
  find("takes").addEventListener("keydown", (event) => {
    if (!["ArrowUp", "ArrowDown"].includes(event.key)) return;
    const rows = [...find("takes").querySelectorAll(".row")], place = rows.indexOf(document.activeElement);
    rows[Math.min(Math.max(place + (event.key === "ArrowUp" ? -1 : 1), 0), rows.length - 1)]?.focus();
    event.preventDefault();
  });
}

export function renderDifference(app) {
  const { difference, changes } = app.take, panel = find("difference");
  const list = (title, entries) => (entries.length ? [build("h3", { textContent: title }), build("ul", {}, ...entries.slice(0, MAX_LISTED),
    ...(entries.length > MAX_LISTED ? [build("li", { textContent: `and ${entries.length - MAX_LISTED} more` })] : []))] : []);
  const known = new Map(changes.map((change) => [change.id, change]));
  const added = difference.added.map((id) => {
    const change = known.get(id);
    if (!change) return build("li", { textContent: id });
    const text = `${change.kind} ${change.markers.join(", ")}, ${change.first}–${change.last}`;
    return build("li", {}, build("button", { type: "button", className: "link", textContent: text, onclick: () => app.select(id) }));
  });
  const markers = difference.markers.map(({ label, samples, largest_mm: largest }) => build("li", {
    textContent: `${label}: ${count(samples, "sample")}, at most ${formatMm(largest)}` }));
  const summary = difference.samples
    ? `${count(difference.samples, "sample")} ${difference.samples === 1 ? "differs" : "differ"} from the cleaning before.`
    : "No samples differ from the cleaning before.";
  panel.replaceChildren(
    build("h2", { textContent: "What differs from before" }),
    build("button", { type: "button", className: "close", textContent: "Close", title: "Close (Esc)", onclick: () => { panel.hidden = true; } }),
    build("p", { textContent: summary }),
    ...list("Markers", markers), ...list("Changes added", added),
    ...list("Changes removed", difference.removed.map((textContent) => build("li", { textContent }))));
  panel.hidden = false;
}

// The list of changes: its order, its filters and its rows. Few rows exist at a time, however many changes there are.

const ROW_HEIGHT = 25;
const SPARE_ROWS = 12;
const WORDS = { accept: "accept", reject: "reject", keep: "keep" };

const compareText = (a, b) => a.localeCompare(b, "en", { numeric: true });
const byError = (a, b) => (b.predicted_mm ?? -1) - (a.predicted_mm ?? -1) || a.first - b.first;
const ORDERS = {
  error: byError,
  first: (a, b) => a.first - b.first || compareText(a.markers[0], b.markers[0]),
  kind: (a, b) => compareText(a.kind, b.kind) || byError(a, b),
  marker: (a, b) => compareText(a.markers[0], b.markers[0]) || a.first - b.first,
};

// Returns the changes that pass the filters, in order.
export function listChanges(changes, { kind, marker, decision, order }) {
  const wanted = marker.trim().toLowerCase();
  return changes
    .filter((each) => !kind || each.kind === kind)
    .filter((each) => !wanted || each.markers.some((label) => label.toLowerCase().includes(wanted)))
    .filter((each) => !decision || (decision === "open" ? !each.is_reviewed : each.is_reviewed && each.decision === decision))
    .sort(ORDERS[order] ?? byError);
}

export class ChangeList {
  constructor(element, { onSelect }) {
    Object.assign(this, { element, onSelect, rows: [], selectedId: null, rate: 1, prefix: "" });
    this.space = document.createElement("div");
    this.space.style.position = "relative";
    element.append(this.space);
    element.addEventListener("scroll", () => this.render());
    element.addEventListener("click", (event) => {
      const row = event.target.closest(".row");
      if (row) onSelect(row.dataset.id);
    });
    new ResizeObserver(() => this.render()).observe(element);
  }

  // Leaves out the name of the subject, if the take has one only.
  shorten(label) { return this.prefix && label.startsWith(this.prefix) ? label.slice(this.prefix.length) : label; }

  setRows(rows, selectedId, { rate, labels }) {
    const prefixes = new Set(labels.map((label) => label.match(/^.*:/)?.[0]).filter(Boolean));
    Object.assign(this, { rows, selectedId, rate, prefix: prefixes.size === 1 ? [...prefixes][0] : "" });
    this.render();
  }

  showSelected() {
    const index = this.rows.findIndex((each) => each.id === this.selectedId);
    if (index < 0) return;
    const top = index * ROW_HEIGHT, { element } = this;
    if (top < element.scrollTop) element.scrollTop = top;
    if (top + ROW_HEIGHT > element.scrollTop + element.clientHeight) element.scrollTop = top + ROW_HEIGHT - element.clientHeight;
    this.render();
  }

  // Returns the id of the row some steps from the selected one.
  findNeighbour(steps) {
    const index = this.rows.findIndex((each) => each.id === this.selectedId);
    const next = index < 0 ? 0 : Math.min(Math.max(index + steps, 0), this.rows.length - 1);
    return this.rows[next]?.id ?? null;
  }

  // Returns the id of the next change after the selected one that is not reviewed, null if there is none.
  findNextOpen() {
    const index = this.rows.findIndex((each) => each.id === this.selectedId);
    const ordered = [...this.rows.slice(index + 1), ...this.rows.slice(0, Math.max(index, 0))];
    return ordered.find((each) => !each.is_reviewed)?.id ?? null;
  }

  render() {
    const { element, space, rows } = this;
    space.style.height = `${rows.length * ROW_HEIGHT}px`;
    const first = Math.max(0, Math.floor(element.scrollTop / ROW_HEIGHT) - SPARE_ROWS);
    const last = Math.min(rows.length, Math.ceil((element.scrollTop + element.clientHeight) / ROW_HEIGHT) + SPARE_ROWS);
    space.replaceChildren(...rows.slice(first, last).map((each, n) => this.buildRow(each, first + n)));
    if (!rows.length) space.replaceChildren(buildCell("No change passes the filters.", "empty"));
  }

  buildRow(change, index) {
    const row = document.createElement("div");
    row.className = "row";
    row.setAttribute("role", "option");
    row.setAttribute("aria-selected", String(change.id === this.selectedId));
    Object.assign(row.dataset, { id: change.id, decision: change.decision, reviewed: String(change.is_reviewed) });
    Object.assign(row.style, { position: "absolute", top: `${index * ROW_HEIGHT}px`, left: 0, right: 0 });
    const seconds = (change.last - change.first + 1) / this.rate;
    const frames = change.first === change.last ? `${change.first}` : `${change.first}–${change.last}`;
    row.title = `${change.kind}, ${change.markers.join(", ")}, ${frames}, ${seconds.toFixed(2)} s`;
    row.append(
      buildCell(change.kind),
      buildCell((change.note ? "✎ " : "") + (change.is_correction ? "★ " : "") + change.markers.map((label) => this.shorten(label)).join(", ")),
      buildCell(frames, "number"),
      buildCell(change.predicted_mm === null ? "" : `${change.predicted_mm.toFixed(change.predicted_mm < 100 ? 1 : 0)} mm`, "number"),
      buildCell(WORDS[change.decision] ?? change.decision, "decision"),
    );
    return row;
  }
}

function buildCell(text, className = "") {
  const cell = document.createElement("span");
  cell.textContent = text;
  cell.className = className;
  return cell;
}

// Fills the list of the user's corrections.
export function renderCorrections(element, corrections, selected, { onSelect, onRemove }) {
  const rows = corrections.map((each, index) => {
    const row = document.createElement("div");
    row.className = "row";
    row.setAttribute("role", "option");
    row.setAttribute("aria-selected", String(index === selected));
    row.dataset.index = index;
    const remove = buildCell("×");
    remove.title = "Remove (Delete)";
    const method = each.method ? `: ${each.method}` : "";
    row.append(buildCell(each.kind + method), buildCell(each.markers.join(", ")), buildCell(`${each.first}–${each.last}`, "number"), remove);
    row.addEventListener("click", () => onSelect(index));
    remove.addEventListener("click", (event) => { event.stopPropagation(); onRemove(index); });
    return row;
  });
  element.replaceChildren(...(rows.length ? rows : [buildCell("None yet. They take effect when the take is cleaned again.", "empty")]));
}

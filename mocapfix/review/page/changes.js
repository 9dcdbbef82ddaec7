// The list of events and their changes: its rows, few of which exist at a time, however many there are.

const ROW_HEIGHT = 25;
const SPARE_ROWS = 12, MAX_NAME_LENGTH = 14, NAME_PX = 7.4;  // letters of two markers in a row; width of a letter

export class ChangeList {
  constructor(element, { onSelect, onFold }) {
    Object.assign(this, { element, onSelect, onFold, rows: [], selectedId: null, rate: 1, prefix: "" });
    this.space = document.createElement("div");
    this.space.style.position = "relative";
    element.append(this.space);
    element.addEventListener("scroll", () => this.render());
    element.addEventListener("click", (event) => {
      const row = event.target.closest(".row");
      if (!row) return;
      if (event.target.matches(".fold")) onFold(row.dataset.id);
      else onSelect(row.dataset.id);
    });
    element.addEventListener("dblclick", (event) => {
      const row = event.target.closest(".row");
      if (row && !event.target.matches(".fold")) onFold(row.dataset.id);
    });
    new ResizeObserver(() => this.render()).observe(element);
  }

  // Leaves out the name of the subject, if the take has one only.
  shorten(label) { return this.prefix && label.startsWith(this.prefix) ? label.slice(this.prefix.length) : label; }

  setRows(rows, selectedId, { rate, labels }) {
    const prefixes = new Set(labels.map((label) => label.match(/^.*:/)?.[0]).filter(Boolean));
    Object.assign(this, { rows, selectedId, rate, prefix: prefixes.size === 1 ? [...prefixes][0] : "" });
    this.space.style.setProperty("--name", `${Math.max(68, ...rows.map((each) => this.nameEntry(each).length * NAME_PX))}px`);  // one width in all rows
    this.render();
  }

  // The first marker of an entry, and how many others or, if they are short, which, after marks of a note and of a correction.
  nameEntry({ markers, note, is_correction: isCorrection }) {
    const [label, ...others] = markers.map((each) => this.shorten(each)), marks = (note ? "✎ " : "") + (isCorrection ? "★ " : "");
    return `${marks}${label}${others.length > 1 || `${label}${others[0] ?? ""}`.length > MAX_NAME_LENGTH ? ` +${others.length}` : others.map((each) => `, ${each}`)}`;
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

  // Returns the id of the next row after the selected one, but not within it, that is not reviewed; null if there is none.
  findNextOpen() {
    const index = this.rows.findIndex((each) => each.id === this.selectedId);
    const ordered = [...this.rows.slice(index + 1), ...this.rows.slice(0, Math.max(index, 0))];
    return ordered.find((each) => !each.is_reviewed && each.parent !== this.selectedId)?.id ?? null;
  }

  render() {
    const { element, space, rows } = this;
    space.style.height = `${rows.length * ROW_HEIGHT}px`;
    const first = Math.max(0, Math.floor(element.scrollTop / ROW_HEIGHT) - SPARE_ROWS);
    const last = Math.min(rows.length, Math.ceil((element.scrollTop + element.clientHeight) / ROW_HEIGHT) + SPARE_ROWS);
    space.replaceChildren(...rows.slice(first, last).map((each, n) => this.buildRow(each, first + n)));
    if (!rows.length) space.replaceChildren(buildCell("No change passes the filters.", "empty"));
  }

  buildRow(entry, index) {
    const row = document.createElement("div");
    row.className = entry.parent ? "row part" : "row";
    row.setAttribute("role", "option");
    row.setAttribute("aria-selected", String(entry.id === this.selectedId));
    if (entry.isOpen !== undefined) row.setAttribute("aria-expanded", String(entry.isOpen));
    Object.assign(row.dataset, { id: entry.id, decision: entry.decision, reviewed: String(entry.is_reviewed), count: entry.changes.length });
    Object.assign(row.style, { position: "absolute", top: `${index * ROW_HEIGHT}px`, left: 0, right: 0 });
    const seconds = (entry.last - entry.first + 1) / this.rate;
    const frames = entry.first === entry.last ? `${entry.first}` : `${entry.first}–${entry.last}`;
    row.title = `${entry.kind}, ${entry.markers.join(", ")}, ${frames}, ${seconds.toFixed(2)} s`;
    row.append(
      buildCell({ true: "▾", false: "▸" }[entry.isOpen] ?? "", "fold"),
      buildCell(this.nameEntry(entry), "name"),
      buildCell(entry.kind, "kind"),
      buildCell(frames, "number"),
      buildCell(entry.predicted_mm === null ? "" : `${entry.predicted_mm.toFixed(entry.predicted_mm < 100 ? 1 : 0)} mm`, "number"),
      buildCell(entry.decision, "decision"),
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
    const method = each.method ? `: ${each.method}` : each.points?.length ? `: ${each.points.length}` : "";
    if (each.prevented) row.title = `Not made: ${each.prevented}`;
    row.append(buildCell(each.kind + method), buildCell(each.markers.join(", ") + (each.prevented ? ": not made" : ""), each.prevented && "error"), buildCell(`${each.first}–${each.last}`, "number"), remove);
    row.addEventListener("click", () => onSelect(index));
    remove.addEventListener("click", (event) => { event.stopPropagation(); onRemove(index); });
    return row;
  });
  element.replaceChildren(...(rows.length ? rows : [buildCell("None yet. They take effect when the take is cleaned again.", "empty")]));
}

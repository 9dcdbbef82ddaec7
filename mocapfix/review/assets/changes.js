/** The list of changes: sorted, filtered, and only with the rows that are in view. */

import { build, count, fillOptions, find, formatMm } from "./elements.js";

const ROW_PX = 44, SPARE_ROWS = 6;
const DECISIONS = { accept: "accepted", reject: "rejected", keep: "kept" };

export class ChangeList {
  constructor(element, select) {
    this.element = element;
    this.select = select;
    this.changes = [];
    this.listed = [];
    this.selected = null;
    this.body = build("div", { className: "rows" });
    this.detail = build("div", { id: "change-detail" });
    this.empty = build("p", { className: "empty", hidden: true });
    element.append(this.body, this.empty);
    this.filters = { kind: find("filter-kind"), marker: find("filter-marker"), decision: find("filter-decision"), sort: find("sort") };
    for (const [name, input] of Object.entries(this.filters)) {
      input.addEventListener(name === "marker" ? "input" : "change", () => {
        this.update();
        this.reveal();
        if (name !== "marker") input.blur();
      });
    }
    element.addEventListener("scroll", () => this.render(), { passive: true });
    element.addEventListener("click", (event) => {
      const row = event.target.closest(".row");
      if (row) this.select(row.dataset.id);
    });
    new ResizeObserver(() => this.reveal()).observe(element);
  }

  setTake(take) {
    this.take = take;
    this.changes = take.changes;
    const kinds = [...new Set(take.changes.map((change) => change.kind))].sort();
    fillOptions(this.filters.kind, [["", "All kinds"], ...kinds.map((kind) => [kind, kind])]);
    this.update();
  }

  setSelected(id) {
    this.selected = id;
    this.render();
    this.reveal();
  }

  update() {
    const { kind, marker, decision, sort } = this.filters, text = marker.value.trim().toLowerCase();
    this.listed = this.changes.filter((change) => (!kind.value || change.kind === kind.value)
      && (!text || change.markers.some((label) => label.toLowerCase().includes(text)))
      && (!decision.value || (decision.value === "open" ? !change.is_reviewed : change.is_reviewed && change.decision === decision.value)));
    this.listed.sort(ORDERS[sort.value]);
    this.positions = new Map(this.listed.map((change, position) => [change.id, position]));
    const open = this.changes.filter((change) => !change.is_reviewed).length;
    find("count").textContent = `${this.listed.length.toLocaleString("en")} of ${count(this.changes.length, "change")}, ${open.toLocaleString("en")} not reviewed`;
    this.empty.textContent = this.changes.length ? "No change passes the filters." : "The cleaning made no changes.";
    this.empty.hidden = this.listed.length > 0;
    this.render();
  }

  findPosition(id = this.selected) {
    return this.positions?.get(id) ?? -1;
  }

  /** The id of the change some places on in the list. */
  findNeighbour(step) {
    const position = this.findPosition();
    const next = position < 0 ? 0 : Math.min(Math.max(position + step, 0), this.listed.length - 1);
    return this.listed[next]?.id ?? null;
  }

  /** The next change in the list that is not reviewed, from the start after the end. */
  findNextOpen(position = this.findPosition()) {
    const order = [...this.listed.slice(position + 1), ...this.listed.slice(0, position + 1)];
    return order.find((change) => !change.is_reviewed)?.id ?? null;
  }

  /** Scroll until the selected row and its reason are in view. */
  reveal() {
    const position = this.findPosition();
    if (position < 0) {
      this.render();
      return;
    }
    const { element } = this, top = position * ROW_PX, bottom = top + ROW_PX + this.detailHeight;
    if (top < element.scrollTop) element.scrollTop = top;
    else if (bottom > element.scrollTop + element.clientHeight) element.scrollTop = Math.min(top, bottom - element.clientHeight);
    this.render();
  }

  render() {
    const { element, listed } = this, position = this.findPosition(), change = listed[position];
    if (change) this.renderDetail(change, position);
    this.detailHeight = change ? this.detail.offsetHeight : 0;
    this.body.style.height = `${listed.length * ROW_PX + this.detailHeight}px`;
    const first = Math.max(0, Math.floor((element.scrollTop - this.detailHeight) / ROW_PX) - SPARE_ROWS);
    const last = Math.min(listed.length, Math.ceil((element.scrollTop + element.clientHeight) / ROW_PX) + SPARE_ROWS);
    const rows = [];
    for (let each = first; each < last; each += 1) {
      const row = this.buildRow(listed[each], each === position);
      row.style.top = `${each * ROW_PX + (position >= 0 && each > position ? this.detailHeight : 0)}px`;
      rows.push(row);
      if (each === position) row.setAttribute("aria-describedby", "change-detail");
    }
    this.body.replaceChildren(...rows, ...(change ? [this.detail] : []));
    if (change && position >= first && position < last) element.setAttribute("aria-activedescendant", "selected-change");
    else element.removeAttribute("aria-activedescendant");
  }

  buildRow(change, isSelected) {
    const decision = change.is_reviewed ? DECISIONS[change.decision] : "not reviewed";
    const seconds = (change.last - change.first + 1) / this.take.rate;
    const row = build("div", {
      className: "row", id: isSelected ? "selected-change" : "", role: "option", ariaSelected: String(isSelected),
      data: { id: change.id, decision: change.decision, reviewed: String(change.is_reviewed) },
    },
    build("span", { className: "kind", textContent: change.kind }),
    build("span", { className: "markers", textContent: change.markers.join(", "), title: change.markers.join(", ") }),
    build("span", { className: "error", textContent: formatMm(change.predicted_mm), title: "Predicted error" }),
    build("span", { className: "frames", textContent: `${change.first}–${change.last}` }),
    build("span", { className: "seconds", textContent: `${seconds.toFixed(2)} s${change.is_correction ? ", your correction" : ""}` }),
    build("span", { className: "note-mark", textContent: change.note ? "note" : "", title: change.note }),
    build("span", { className: "decision", textContent: decision }));
    return row;
  }

  renderDetail(change, position) {
    const lines = [change.why, change.method, describeBeforeAndAfter(change), change.note && `Note: ${change.note}`];
    this.detail.replaceChildren(...lines.filter(Boolean).map((textContent) => build("p", { textContent })));
    this.detail.style.top = `${(position + 1) * ROW_PX}px`;
    if (!this.detail.isConnected) this.body.append(this.detail);
  }
}

const compareFrames = (one, other) => one.first - other.first || one.id.localeCompare(other.id);
const ORDERS = {
  unsure: (one, other) => (other.predicted_mm ?? -1) - (one.predicted_mm ?? -1) || compareFrames(one, other),
  frame: compareFrames,
  kind: (one, other) => one.kind.localeCompare(other.kind) || compareFrames(one, other),
  marker: (one, other) => one.markers.join().localeCompare(other.markers.join()) || compareFrames(one, other),
};

function describeBeforeAndAfter({ before, after, samples }) {
  const describe = (part) => [
    part?.missing ? `${part.missing} missing` : "",
    typeof part?.off_body_mm === "number" ? `${part.off_body_mm.toFixed(0)} mm off the body` : "",
  ].filter(Boolean).join(", ");
  const parts = [count(samples ?? 0, "sample")];
  if (describe(before)) parts.push(`before: ${describe(before)}`);
  if (describe(after)) parts.push(`after: ${describe(after)}`);
  return `${parts.join("; ")}.`;
}

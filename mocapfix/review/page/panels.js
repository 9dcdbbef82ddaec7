// The smaller parts of the page: the reason of a change, what differs from the cleaning before, and the list of takes.

function build(tag, text = "", className = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  if (className) element.className = className;
  return element;
}

// Shows why a change of a row was made, and how; of an event also what it is.
export function renderDetail(element, entry, change, take) {
  if (!entry) {
    element.replaceChildren(build("span", "Select a change to see why it was made.", "empty"));
    return;
  }
  const { before, after } = change;
  const method = change.method.charAt(0).toUpperCase() + change.method.slice(1);
  const parts = [build("b", `${change.kind}: ${change.markers.join(", ")}. `), build("span", `${change.why} ${method}.`)];
  const facts = [`${change.samples} samples`];
  if (before.missing || after.missing) facts.push(`missing ${before.missing} → ${after.missing}`);
  if (before.off_body_mm !== null && after.off_body_mm !== null) facts.push(`from the body ${before.off_body_mm} → ${after.off_body_mm} mm`);
  if (change.predicted_mm !== null) facts.push(`predicted error ${change.predicted_mm} mm`);
  if (change.reviewer) facts.push(`decided by ${change.reviewer}`);
  parts.push(build("div", facts.join(" · ")));
  if (change.note) parts.push(build("div", change.note, "note"));
  if (entry.changes.length > 1) {
    const seconds = ((entry.last - entry.first + 1) / take.rate).toFixed(2);
    const what = `${entry.changes.length} changes of ${entry.markers.join(", ")} in frames ${entry.first} to ${entry.last} (${seconds} s). ${change === entry.changes[0] ? "The least certain" : "That of this marker"}: `;
    parts.unshift(build("div", what));
  }
  element.replaceChildren(...parts);
}

// Shows what differs from the cleaning before; nothing without one.
export function renderDifference(element, difference) {
  element.hidden = !difference;
  if (!difference) return;
  const close = build("button", "Close");
  close.addEventListener("click", () => { element.hidden = true; });
  const table = document.createElement("table");
  const addRow = (cells, tag) => {
    const row = table.insertRow();
    for (const text of cells) row.append(build(tag, text));
    return row;
  };
  if (difference.markers.length) addRow(["Marker", "Samples", "Largest distance"], "th");
  for (const each of difference.markers) {
    addRow([each.label, String(each.samples), each.largest_mm === null ? "removed or added" : `${each.largest_mm} mm`], "td");
  }
  const changes = build("div");
  for (const [name, ids] of [["New changes", difference.added], ["Changes that are no longer made", difference.removed]]) {
    if (ids.length) changes.append(build("div", `${name}: ${ids.join(", ")}`));
  }
  const count = `${difference.samples} ${difference.samples === 1 ? "sample differs" : "samples differ"} from the cleaning before.`;
  element.replaceChildren(build("h3", "What differs from before"), build("div", count), table, changes, close);
}

// Returns the takes of a session, those that need a look first: the worst prediction, then takes with errors, then approved ones.
export function orderTakes(takes) {
  const rank = (take) => (take.state === "approved" ? 2 : take.error ? 1 : 0);
  return [...takes].sort((a, b) => rank(a) - rank(b) || (b.worst_mm ?? -1) - (a.worst_mm ?? -1));
}

// Shows the takes of a session with their states.
export function renderTakes(element, takes, openId, open) {
  if (element.hidden) return;
  const rows = takes.map((take) => {
    const row = build("div", "", "row");
    row.dataset.id = take.id;
    row.setAttribute("aria-selected", String(take.id === openId));
    const worst = take.worst_mm === null ? "" : `worst ${take.worst_mm.toFixed(1)} mm`;
    row.append(build("span", take.id), build("span", take.error || take.state), build("span", `${take.reviewed_count} of ${take.change_count} reviewed`, "number"), build("span", worst, "number"));
    row.title = take.error || (take.approved_by ? `approved by ${take.approved_by} on ${take.approved_at}` : take.name);
    row.addEventListener("click", () => { element.hidden = true; open(take.id); });
    return row;
  });
  element.replaceChildren(build("h3", "Takes"), ...rows);
}

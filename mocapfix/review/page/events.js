// The events of a take: changes at one time of neighbouring markers. Their summaries, order and filters, and which a limit accepts.

// Limits of the predicted error in millimetres that the slider offers.
export const LIMITS_MM = [1, 2, 3, 5, 7, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 250];
export const DEFAULT_LIMIT_MM = 30;

const compareText = (a, b) => a.localeCompare(b, "en", { numeric: true });
const byError = (a, b) => (b.predicted_mm ?? -1) - (a.predicted_mm ?? -1) || a.first - b.first;
const ORDERS = {
  error: byError,
  first: (a, b) => a.first - b.first || compareText(a.markers[0], b.markers[0]),
  kind: (a, b) => compareText(a.kind, b.kind) || byError(a, b),
  marker: (a, b) => compareText(a.markers[0], b.markers[0]) || a.first - b.first,
};
const CORRECTION_KINDS = { marked: ["wrong", "missing"], swap: ["swap"], fragment: ["assign"] };  // by the kind of the change that follows
const unite = (values) => [...new Set(values)];
const known = (values) => values.filter((each) => each !== null);

// Returns whether a change follows from one of the user's corrections.
const isCorrection = ({ kind, markers, first }, corrections) => corrections.some(
  (each) => CORRECTION_KINDS[kind]?.includes(each.kind) && each.first === first && each.markers.join("\n") === markers.join("\n"),
);

// Returns what a row says of some changes.
export function summarise(id, changes) {
  const decisions = unite(changes.map((each) => each.decision)), predicted = known(changes.map((each) => each.predicted_mm));
  return {
    id, changes, kind: unite(changes.map((each) => each.kind)).join(", "), markers: unite(changes.flatMap((each) => each.markers)),
    first: Math.min(...changes.map((each) => each.first)), last: Math.max(...changes.map((each) => each.last)),
    predicted_mm: predicted.length ? Math.max(...predicted) : null,
    decision: decisions.length === 1 ? decisions[0] : "mixed", is_reviewed: changes.every((each) => each.is_reviewed),
    note: changes.some((each) => each.note), is_correction: changes.some((each) => each.is_correction),
  };
}

// Returns the events of which changes pass the filters, in order. An event of one change has the id of this change. `limit_mm` is
// the largest predicted error of all its changes, of those too that do not pass; infinite if one has no prediction.
export function listEvents(take, { kind, marker, decision, order }) {
  const wanted = marker.trim().toLowerCase();
  const passes = (each) => (!kind || each.kind === kind)
    && (!wanted || each.markers.some((label) => label.toLowerCase().includes(wanted)))
    && (!decision || (decision === "open" ? !each.is_reviewed : each.is_reviewed && each.decision === decision));
  const byId = new Map(take.changes.map((each) => [each.id, { ...each, is_correction: isCorrection(each, take.corrections) }]));
  return take.events
    .map((ids) => ids.map((id) => byId.get(id)).filter(Boolean))
    .map((all) => ({ changes: all.filter(passes).sort(byError), limit_mm: Math.max(...all.map((each) => each.predicted_mm ?? Infinity)) }))
    .filter(({ changes }) => changes.length)
    .map(({ changes, limit_mm }) => {
      const id = changes.length === 1 ? changes[0].id : `event ${unite(changes.map((each) => each.id)).sort()[0]}`;
      return { ...summarise(id, changes), limit_mm };
    })
    .sort(ORDERS[order] ?? byError);
}

// Returns the rows of a list: the events, and below those that are unfolded their changes.
export function listRows(events, unfolded) {
  return events.flatMap((event) => {
    if (event.changes.length === 1) return [event];
    const isOpen = unfolded.has(event.id);
    const parts = isOpen ? event.changes.map((each) => ({ ...summarise(each.id, [each]), parent: event.id })) : [];
    return [{ ...event, isOpen }, ...parts];
  });
}

// Divides the events that are not reviewed by a limit of the predicted error: an event is within it if all its changes are.
export function divideByLimit(events, limitMm) {
  const open = events.filter((each) => !each.is_reviewed);
  const isWithin = (each) => each.limit_mm <= limitMm;
  return { within: open.filter(isWithin), above: open.filter((each) => !isWithin(each)) };
}

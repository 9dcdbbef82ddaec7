"""Lists of the HTML report: figures of the largest changes, all changes, unchanged faults and empty intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from mocapfix.changes import Change
from mocapfix.faults import MISSING_KINDS, Fault
from mocapfix.report.change_figures import build_change_curves, draw_change_figure
from mocapfix.report.report import LeftEmptyEntry, UnfilledEntry
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.summary import format_severity
from mocapfix.report.terms import format_frame_range, format_number

MAX_LIST_ROWS = 1000  # rows of a list; the JSON report has all of them
MAX_OPEN_LIST_ROWS = 40  # longer lists are collapsed
MAX_CHANGE_FIGURES = 12
# Kinds whose severity is the distance that the marker travelled, not its distance from the correct position.
TRAVEL_SEVERITY_KINDS = (*MISSING_KINDS, "segment lost", "computed")


@dataclass(frozen=True)
class Figure:
    """An SVG with its caption: a name in bold and a text."""

    svg: Markup
    name: str
    text: str


@dataclass(frozen=True)
class TableList:
    """A table that can be collapsed.

    title    number of rows and what they are
    omitted  number of rows beyond MAX_LIST_ROWS
    """

    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    is_open: bool
    omitted: int


def select_worst_changes(comparison: CleaningComparison) -> list[tuple[Change, Fault]]:
    """Return at most MAX_CHANGE_FIGURES applied changes, the worst first, including the worst of each kind."""
    rate = comparison.input_take.rate
    ordered = sorted(comparison.applied_changes, key=lambda pair: -_compute_change_weight(*pair, rate))
    first_of_kind: dict[str, int] = {}
    for n, (change, _) in enumerate(ordered):
        first_of_kind.setdefault(change.kind, n)
    others = (n for n in range(len(ordered)) if n not in first_of_kind.values())
    return [ordered[n] for n in sorted([*first_of_kind.values(), *others][:MAX_CHANGE_FIGURES])]


def _compute_change_weight(change: Change, fault: Fault, rate_hz: float) -> float:
    """Return duration times the sum of the error before and the predicted error after, in metre-seconds.

    A rotation of one radian counts as one metre.
    """
    error_before = 0.0 if fault.kind in TRAVEL_SEVERITY_KINDS or np.isnan(fault.severity) else fault.severity
    error_after = (change.predicted_mm or 0.0) / 1e3
    return (fault.last - fault.first + 1) / rate_hz * (error_before + error_after)


def build_change_figures(comparison: CleaningComparison) -> list[Figure]:
    """Return the figures of the worst changes."""
    return [_build_change_figure(comparison, change, fault) for change, fault in select_worst_changes(comparison)]


def _build_change_figure(comparison: CleaningComparison, change: Change, fault: Fault) -> Figure:
    curves = build_change_curves(comparison, fault)
    svg = draw_change_figure(curves, fault.first, fault.last, comparison.input_take.first_frame)
    frames = f"frame{'s' if change.last > change.first else ''} {format_frame_range(change.first, change.last)}"
    sentences = [_describe_change(change)]
    if change.predicted_mm is not None:
        sentences.append(f"Predicted error {format_number(change.predicted_mm)} mm.")
    if curves.reference_labels:
        sentences.append(f"Relative to {', '.join(curves.reference_labels)}.")
    if curves.frames[-1] < fault.last:
        sentences.append("Only the beginning is shown.")
    return Figure(svg, f"{change.kind}: {', '.join(change.markers)}, {frames}.", " ".join(sentences))


def _describe_change(change: Change) -> str:
    """Return why the change was made, and how."""
    method = f"{change.method[:1].upper()}{change.method[1:]}" if change.decision == "accept" else "Not applied"
    return f"{change.why} {method}."


def build_change_list(comparison: CleaningComparison) -> TableList | None:
    """Return the table of all changes; None without changes."""
    rows = [
        (
            change.id,
            ", ".join(change.markers),
            format_frame_range(change.first, change.last),
            _describe_change(change),
            _format_before_after(change.before.missing, change.after.missing, 0),
            _format_before_after(change.before.off_body_mm, change.after.off_body_mm, 1),
            format_number(change.predicted_mm) if change.predicted_mm is not None else "",
            change.decision,
        )
        for change in comparison.changes[:MAX_LIST_ROWS]
    ]
    points = comparison.terms.points.capitalize()
    header = ("Change", points, "Frames", "Reason and method", "Missing", "From body, mm", "Predicted, mm", "Decision")
    return _build_list("change", len(comparison.changes), header, rows)


def _format_before_after(before: int | float | None, after: int | float | None, digits: int) -> str:
    """Return "before → after", empty if both are zero or unknown."""
    if (before, after) in ((0, 0), (None, None)):
        return ""
    return f"{format_number(before, digits)} → {format_number(after, digits)}"


def build_unchanged_list(comparison: CleaningComparison) -> TableList | None:
    """Return the table of the faults that were left as measured; None without any."""
    take = comparison.input_take
    faults = [fault for fault in comparison.unchanged_faults if fault.kind not in MISSING_KINDS]
    rows = [
        (
            fault.kind,
            take.get_label(fault.marker),
            format_frame_range(take.get_frame_number(fault.first), take.get_frame_number(fault.last)),
            format_severity(fault),
            fault.reason,
        )
        for fault in faults[:MAX_LIST_ROWS]
    ]
    header = ("Kind", comparison.terms.point.capitalize(), "Frames", "Severity", "Reason")
    return _build_list("fault", len(faults), header, rows)


def build_unfilled_list(entries: Sequence[UnfilledEntry], comparison: CleaningComparison) -> TableList | None:
    """Return the table of the empty intervals and their reasons; None without any."""
    rows = [
        (entry["marker"], format_frame_range(entry["first"], entry["last"]), entry["reason"]) for entry in entries[:MAX_LIST_ROWS]
    ]
    return _build_list("interval", len(entries), (comparison.terms.point.capitalize(), "Frames", "Reason"), rows)


def build_left_list(entries: Sequence[LeftEmptyEntry], comparison: CleaningComparison) -> TableList | None:
    """Return the table of the samples that stay empty by marker, and their reasons; None without any."""
    rows = [
        (
            entry["marker"],
            f"{entry['samples']:,}",
            "; ".join(f"{count:,}: {reason}" for reason, count in entry["reasons"].items()),
        )
        for entry in entries[:MAX_LIST_ROWS]
    ]
    name, points = comparison.terms.point, comparison.terms.point.capitalize()
    return _build_list(name, len(entries), (points, f"Empty {comparison.terms.samples}", "Number and reason"), rows)


def _build_list(name: str, count: int, header: tuple[str, ...], rows: list[tuple[str, ...]]) -> TableList | None:
    if not count:
        return None
    title = f"{count:,} {name}s" if count > 1 else f"{count:,} {name}"
    return TableList(title, header, rows, count <= MAX_OPEN_LIST_ROWS, max(0, count - MAX_LIST_ROWS))

"""Which changes are worth a picture: of every kind the worst, and then the worst of all."""

import shlex
from html import escape

import numpy as np

from mocapfix.animation import Animation
from mocapfix.changes import Change
from mocapfix.faults import MISSING_KINDS, Fault
from mocapfix.report import change_curves
from mocapfix.report.change_figures import draw_change_figure
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.html_elements import (
    MAX_LIST_ROWS,
    format_frame_range,
    render_collapsible_list,
    render_legend,
    render_table,
    render_truncation_note,
)
from mocapfix.report.summary import format_number, format_severity
from mocapfix.report.terms import use_joint_terms

# MERGED: mocapfix.show.worst
MAX_CHANGE_FIGURES = 12
TRAVEL_SEVERITY_KINDS = (
    *MISSING_KINDS,
    "segment lost",
    "computed",
)  # whose severity is how far the marker went, not how far off it was


def select_worst_changes(comparison: CleaningComparison) -> list[tuple[Change, Fault]]:
    """-> at most PICTURES changes that were made, the worst first, the worst of each kind among them."""
    ordered = sorted(comparison.applied_changes, key=lambda pair: -_compute_change_weight(*pair, comparison.input_take.rate))
    of_kind: dict[str, int] = {}
    for n, (change, _) in enumerate(ordered):
        of_kind.setdefault(change.kind, n)
    others = (n for n in range(len(ordered)) if n not in of_kind.values())
    return [ordered[n] for n in sorted([*of_kind.values(), *others][:MAX_CHANGE_FIGURES])]


def _compute_change_weight(change: Change, fault: Fault, rate_hz: float) -> float:
    """-> metre-seconds (a radian is as a metre): for how long it lasts, how far off the samples were, how unsure they are now."""
    off = 0.0 if fault.kind in TRAVEL_SEVERITY_KINDS or np.isnan(fault.severity) else fault.severity
    unsure = (change.predicted_mm or 0.0) / 1e3
    return (fault.last - fault.first + 1) / rate_hz * (off + unsure)


# MERGED: mocapfix.show.entries
# The lists of the report page: every change with pictures of the worst ones, what was left as it was, what is empty.
# Classes of the page's style sheet, and what they mean.
CHANGE_LEGEND = (
    ("was", "as it was"),
    ("now", "as it is now"),
    ("kept", "not changed"),
    ("band", "where 95 in 100 are predicted to lie"),
    ("when", "the change"),
)
MARKER_CURVES_CAPTION = (
    "Paths are seen from the markers nearest by, x, y (up) and z on one scale; dashed is the other marker concerned. "
    "Of a marker that moved on its segment there are the distances from its neighbours."
)
JOINT_CURVES_CAPTION = (
    "Paths are those of the joints’ tips, the middle of what hangs on them, seen from the tip of the joint above, x, y (up) and "
    "z on one scale; dashed are other joints concerned."
)
CHANGE_TABLE_HEADER = (
    "Change",
    "Markers",
    "Frames",
    "Why, and what was done",
    "Missing",
    "From body, mm",
    "Predicted, mm",
    "Decision",
)


def render_worst_changes(comparison: CleaningComparison) -> str:
    """The worst changes, each with its picture."""
    figures = "".join(_render_change(comparison, *pair) for pair in select_worst_changes(comparison))
    if not figures:
        return ""
    words = JOINT_CURVES_CAPTION if isinstance(comparison.input_take.layout, Animation) else MARKER_CURVES_CAPTION
    return (
        f'<h2>The worst changes</h2><p class="soft">{words}</p>{render_legend(CHANGE_LEGEND)}<div class="changes">{figures}</div>'
    )


def _render_change(comparison: CleaningComparison, change: Change, fault: Fault) -> str:
    shown = change_curves.build_change_curves(comparison, fault)
    drawn = draw_change_figure(shown, fault.first, fault.last, comparison.input_take.first_frame)
    name = f"{change.kind}: {', '.join(change.markers)}, {_format_change_frames(change)}."
    surely = "" if change.predicted_mm is None else f" Predicted error {format_number(change.predicted_mm)} mm."
    seen_from = f" Seen from {', '.join(shown.reference_labels)}." if shown.reference_labels else ""
    cut = " Only its beginning is shown." if shown.frames[-1] < fault.last else ""
    text = escape(f"{_describe_change(change)}{surely}{seen_from}{cut}")
    return f"<figure>{drawn}<figcaption><b>{escape(name)}</b> {text}</figcaption></figure>"


def _format_change_frames(change: Change) -> str:
    return f"frame{'s' if change.last > change.first else ''} {format_frame_range(change.first, change.last)}"


def _describe_change(change: Change) -> str:
    """-> why it was made, and how."""
    method = f"{change.method[:1].upper()}{change.method[1:]}" if change.decision == "accept" else "Not made"
    return f"{change.why} {method}."


def render_change_list(comparison: CleaningComparison) -> str:
    """Every change, and how somebody takes one back."""
    if not comparison.changes:
        return ""
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
    head = [use_joint_terms(name, comparison.input_take) for name in CHANGE_TABLE_HEADER]
    listed = render_collapsible_list(
        "change", len(comparison.changes), render_table(head, rows) + render_truncation_note(len(comparison.changes))
    )
    return f'<h2>All changes</h2><div class="entries">{listed}</div>{_render_review_instructions(comparison)}'


def _format_before_after(before: float | None, after: float | None, digits: int) -> str:
    """-> a number before and after; nothing where there is none."""
    return (
        f"{format_number(before, digits)} → {format_number(after, digits)}"
        if (before, after) not in ((0, 0), (None, None))
        else ""
    )


def _render_review_instructions(comparison: CleaningComparison) -> str:
    name = comparison.input_take.path.name if comparison.input_take.path else "TAKE"
    file = f"{comparison.input_take.output_stem}.changes.yaml"
    believed = use_joint_terms("what was measured there is believed", comparison.input_take)
    command = shlex.join(["mocapfix", "clean", name, "--changes", file, "--overwrite"])
    return (
        f'<p class="soft">To take a change back, set its decision in {escape(file)} to “reject” (or to “keep”: {believed}) '
        f"and clean again: <code>{escape(command)}</code></p>"
    )


def render_unchanged_faults(comparison: CleaningComparison) -> str:
    """What was found and kept as it was measured."""
    take, found = comparison.input_take, [fault for fault in comparison.unchanged_faults if fault.kind not in MISSING_KINDS]
    if not found:
        return ""
    rows = [
        (
            fault.kind,
            take.get_label(fault.marker),
            format_frame_range(take.get_frame_number(fault.first), take.get_frame_number(fault.last)),
            format_severity(fault),
            fault.reason,
        )
        for fault in found[:MAX_LIST_ROWS]
    ]
    listed = render_table(("Kind", use_joint_terms("Marker", take), "Frames", "How far", "What was found"), rows)
    return f"<h2>Found, and kept as it was</h2>{render_collapsible_list('fault', len(found), listed + render_truncation_note(len(found)))}"


def render_unfilled_runs(report: dict, comparison: CleaningComparison) -> str:
    """What is still missing, and why."""
    rows = [(item["marker"], format_frame_range(item["first"], item["last"]), item["reason"]) for item in report["fill"]["left"]]
    if not rows:
        return ""
    head = (use_joint_terms("Marker", comparison.input_take), "Frames", "Why")
    return f"<h2>Left empty</h2>{render_collapsible_list('stretch', len(rows), render_table(head, rows[:MAX_LIST_ROWS]) + render_truncation_note(len(rows)))}"

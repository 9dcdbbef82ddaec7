"""Summary of a report: the faults of the take, the changes, and what remains."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from mocapfix.errors import join_names, join_words
from mocapfix.faults import MISSING_KINDS, Fault, Fragment
from mocapfix.report.report import Report
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.terms import JOINT_TERMS, format_fault_counts, format_number

UNMATCHED_RELATIONS = ("other", "doubles")  # fragments that belong to no marker


def describe_faults(report: Report, comparison: CleaningComparison) -> str:
    """Return the number of faults of each kind, the missing samples, the longest gap and the unmatched trajectories."""
    take, terms, marker_count = comparison.input_take, comparison.terms, report["take"]["markers"]
    unmatched = [f for f in comparison.faults.items if isinstance(f, Fragment) and f.relation in UNMATCHED_RELATIONS]
    faults = [fault for fault in comparison.faults.items if fault not in unmatched]
    text = f"No faults: every {terms.point} is visible in every frame."
    if faults:
        # The position of an animation's root is a point of its own, after the joints; its faults are the root's.
        count = len({m if m < marker_count else 0 for fault in faults for m in fault.markers})
        kinds = format_fault_counts(fault.kind for fault in faults)
        text = f"{count} of {marker_count} {terms.points} {'has' if count == 1 else 'have'} faults: {kinds}."
    if missing := report["fill"]["missing_before"]:
        total = take.visible.size
        text += f" {missing:,} of {total:,} {terms.samples} ({missing / total:.1%}) were missing."
        text += _describe_longest_gap(comparison, faults)
    if unmatched:
        donors = len({fault.donor for fault in unmatched})
        trajectories = "trajectory matches" if donors == 1 else "trajectories match"
        text += f" {donors:,} unlabelled {trajectories} no marker."
    return text


def _describe_longest_gap(comparison: CleaningComparison, faults: Sequence[Fault]) -> str:
    gaps, take = [fault for fault in faults if fault.kind in MISSING_KINDS], comparison.input_take
    if not gaps:
        return ""
    longest = max(gaps, key=lambda fault: fault.last - fault.first)
    label, duration_s = take.get_label(longest.marker), (longest.last - longest.first + 1) / take.rate
    if longest.kind == "absent":
        return f" {label} is never visible."
    first, last = take.get_frame_number(longest.first), take.get_frame_number(longest.last)
    return f" The longest gap is that of {label}, frames {first} to {last} ({duration_s:.2f} s)."


def describe_changes(report: Report, comparison: CleaningComparison) -> str:
    """Return the number of relabelled, replaced and filled samples, how they were estimated, and the declined changes."""
    fill, terms = report["fill"], comparison.terms
    counts = (
        (fill["relabelled"], "was relabelled", "were relabelled"),
        (fill["replaced"], "was replaced as faulty", "were replaced as faulty"),
        (fill["filled"], "was missing and is filled", "were missing and are filled"),
    )
    parts = [
        f"{count:,} {terms.sample if count == 1 else terms.samples} {one if count == 1 else many}"
        for count, one, many in counts
        if count
    ]
    declined = _describe_declined_changes(report)
    if not parts:
        return f"No changes: all {terms.samples} are as {terms.measured}.{declined}"
    text = f"{join_words(parts)}; every other {terms.sample} is as {terms.measured}.{declined}"
    if not fill["filled"] and not fill["replaced"]:
        return text
    if terms is JOINT_TERMS:
        return f"{text} The method is listed with each change below."
    if report["subject"] is None or report["solve"] is None:
        return f"{text} No body was used: the estimates come from the other markers and the markers’ own trajectories."
    residual = report["solve"]["marker_residual_mm"]
    mean, p95 = format_number(residual["mean"]), format_number(residual["p95"])
    distance = f"The body's mean distance from the markers is {mean} mm (95th percentile {p95} mm)."
    return (
        f"{text} The estimates come from the solved body and the other markers; the method is listed with each change. {distance}"
    )


def _describe_declined_changes(report: Report) -> str:
    """Return a sentence on the changes that a review rejected or kept as measured."""
    counts = Counter(change["decision"] for change in report["changes"])
    names = {"reject": "rejected", "keep": "kept as measured"}
    parts = [f"{counts[decision]:,} {name}" for decision, name in names.items() if counts[decision]]
    return f" Declined in review: {join_words(parts)}." if parts else ""


def describe_remaining(report: Report, comparison: CleaningComparison) -> str:
    """Return the number of samples that are still missing, the faults that were left unchanged, and the parts lost in sight."""
    fill, terms = report["fill"], comparison.terms
    missing = fill["left_empty"]
    text = f"No missing {terms.samples}."
    if missing:
        labels = list(dict.fromkeys(item["marker"] for item in fill["unfilled"]))
        text = f"{missing:,} {terms.sample if missing == 1 else terms.samples} still missing"
        text += f": {join_names(labels)}. The reasons are listed below." if labels else "."
    unchanged = [f.kind for f in comparison.unchanged_faults if f.kind not in (*MISSING_KINDS, "fragment")]
    text += f" Unchanged faults: {format_fault_counts(unchanged)}." if unchanged else ""
    return text + _describe_lost_parts(report)


def _describe_lost_parts(report: Report) -> str:
    """Return a sentence on the parts of the body that the solve lost although their markers are seen; empty without any."""
    lost = report["solve"]["lost_in_sight"] if report["solve"] else {}
    parts = [f"{name} ({count:,} frame{'' if count == 1 else 's'})" for name, count in lost.items()]
    return f" Lost by the solved body although their markers are seen: {join_words(parts)}." if parts else ""


def format_severity(fault: Fault) -> str:
    """Return the severity of a fault with its unit, a dash if it is unknown."""
    value, unit = 1e3 * fault.severity, "mm"
    if fault.severity_unit == "rad":
        value, unit = float(np.degrees(fault.severity)), "degrees"
    return f"{format_number(value, 0)} {unit}" if np.isfinite(value) else format_number(None)

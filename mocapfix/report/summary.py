"""What a technician reads first: what was wrong with the take, what was done about it, and what was left."""

from collections import Counter

import numpy as np

from mocapfix.animation import Animation
from mocapfix.faults import MISSING_KINDS, Fault, Fragment
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.terms import format_fault_counts, join_words, use_joint_terms

MAX_SENTENCE_MARKERS = 12  # markers in one sentence at most


def describe_faults(report: dict, comparison: CleaningComparison) -> str:
    """-> a few sentences on the faults: how many, of which kinds, the longest gap, and what belongs to no marker."""
    take, count = comparison.input_take, report["take"]["markers"]
    none = [fault for fault in comparison.faults.items if isinstance(fault, Fragment) and fault.relation in ("other", "doubles")]
    faults = [fault for fault in comparison.faults.items if fault not in none]
    text = use_joint_terms("Nothing: every marker is there in every frame, and none strays.", take)
    if faults:
        marked = len({m if m < count else 0 for fault in faults for m in fault.markers})  # a root's place is the root's
        kinds = format_fault_counts(fault.kind for fault in faults)
        text = f"{marked} of {count} {use_joint_terms('markers', take)} {'has' if marked == 1 else 'have'} faults: {kinds}."
    if missing := report["fill"]["missing_before"]:
        text += f" {missing:,} of {take.visible.size:,} {use_joint_terms('samples', take)} ({missing / take.visible.size:.1%}) were missing."
        text += _describe_longest_gap(comparison, faults)
    if none:
        donors = len({fault.donor for fault in none})
        text += (
            f" {donors:,} trajector{'y' if donors == 1 else 'ies'} without a marker’s name continue{'s' * (donors == 1)} none."
        )
    return text


def _describe_longest_gap(comparison: CleaningComparison, faults: list[Fault]) -> str:
    gaps, take = [fault for fault in faults if fault.kind in MISSING_KINDS], comparison.input_take
    if not gaps:
        return ""
    longest = max(gaps, key=lambda fault: fault.last - fault.first)
    label, seconds = take.get_label(longest.marker), (longest.last - longest.first + 1) / take.rate
    if longest.kind == "absent":
        return f" {label} is never seen."
    first, last = take.get_frame_number(longest.first), take.get_frame_number(longest.last)
    return f" The longest gap is {label}’s, frames {first} to {last} ({seconds:.2f} s)."


def describe_changes(report: dict, comparison: CleaningComparison) -> str:
    """-> sentences on what was relabelled, replaced and filled, from what, and what somebody decided against."""
    fill, solve, subject = report["fill"], report["solve"], report["subject"]
    parts = [
        f"{fill[key]:,} {use_joint_terms(one if fill[key] == 1 else many, comparison.input_take)}"
        for key, one, many in (
            ("relabelled", "sample was put under its own label", "samples were put under their own labels"),
            ("mended", "faulty one was replaced", "faulty ones were replaced"),
            ("filled", "of the missing samples was filled", "of the missing samples were filled"),
        )
        if fill[key]
    ]
    if not parts:
        nothing = use_joint_terms("Nothing was changed: the samples are as they were measured.", comparison.input_take)
        return f"{nothing}{_describe_rejections(report)}"
    text = f"{join_words(parts)}; {use_joint_terms('every other sample is as it was measured', comparison.input_take)}.{_describe_rejections(report)}"
    if not fill["filled"] and not fill["mended"]:
        return text
    if isinstance(comparison.input_take.layout, Animation):
        return f"{text} Each change below says how."
    if subject is None or solve is None:
        return f"{text} No body was used: the samples come from the other markers and from the markers’ own paths."
    residual = solve["marker_residual_mm"]
    return (
        f"{text} A body with this person’s bones places them; the seen markers lie "
        f"{format_number(residual['mean'])} mm from it on average, 95% of them within {format_number(residual['p95'])} mm."
    )


def _describe_rejections(report: dict) -> str:
    """What was not made since somebody decided so."""
    against = Counter(change["decision"] for change in report["changes"])
    said = {"reject": "rejected", "keep": "kept as measured"}
    words = [f"{against[decision]:,} {word}" for decision, word in said.items() if against[decision]]
    return f" Not made, by decision: {join_words(words)}." if words else ""


def describe_remaining(report: dict, comparison: CleaningComparison) -> str:
    """-> sentences on the samples that are still missing, and on the faults that were kept."""
    fill, take = report["fill"], comparison.input_take
    text = use_joint_terms("No sample is missing any more.", take)
    if fill["left_empty"]:
        markers = list(dict.fromkeys(item["marker"] for item in fill["left"]))
        text = f"{fill['left_empty']:,} {use_joint_terms('sample is' if fill['left_empty'] == 1 else 'samples are', take)} still missing"
        names = [
            *markers[:MAX_SENTENCE_MARKERS],
            *([f"{len(markers) - MAX_SENTENCE_MARKERS} more"] if len(markers) > MAX_SENTENCE_MARKERS else []),
        ]
        text = f"{text}, on {join_words(names)}: see the reasons below." if markers else f"{text}."
    kept = format_fault_counts(
        fault.kind for fault in comparison.unchanged_faults if fault.kind not in (*MISSING_KINDS, "fragment")
    )
    return f"{text} Found and kept: {kept}." if kept else text if fill["left_empty"] else f"Nothing: {text[0].lower()}{text[1:]}"


def format_severity(fault: Fault) -> str:
    """-> how severe a fault is, with its unit; a dash where it is not known."""
    value, unit = (np.degrees(fault.severity), "degrees") if fault.severity_unit == "rad" else (1e3 * fault.severity, "mm")
    return f"{format_number(value, 0)} {unit}" if np.isfinite(value) else format_number(None)


def format_number(value: float | None, digits: int = 1) -> str:
    """-> a number as the page shows it, a dash where it is not known."""
    return "–" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"

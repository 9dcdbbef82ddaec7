"""The HTML report: a self-contained page on the faults of a take, the changes, and what remains; and rendering of such pages."""

import base64
import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from jinja2 import Environment, PackageLoader, StrictUndefined

from mocapfix.errors import join_names
from mocapfix.io.files import replace_atomically
from mocapfix.model.changes import Change, compute_distance_error_mm
from mocapfix.model.faults import MISSING_KINDS
from mocapfix.model.take import Take
from mocapfix.report.change_figures import (
    Figure,
    build_change_figure,
    describe_change,
    describe_changes,
    describe_faults,
    describe_remaining,
    format_severity,
    select_worst_changes,
)
from mocapfix.report.notes import MAX_RELIABLE_FILL_SD_M
from mocapfix.report.report import Report
from mocapfix.report.sample_states import (
    AMBER,
    BLUE,
    GREEN,
    RED,
    VIOLET,
    CleaningComparison,
    SampleOutcome,
    classify_input_samples,
    find_estimated_samples,
)
from mocapfix.report.stick_figures import build_hand_figures, build_moving_figures
from mocapfix.report.terms import FAULT_GROUPS, format_fault_counts, format_frame_range, format_number, get_fault_group
from mocapfix.report.timeline import build_contact_part, build_fault_rows, build_residual_plot, build_time_ticks

PAGE_COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET, "blue": BLUE}


def write_page(target: Path, template: str, **values: object) -> None:
    """Render a template to a file. Values are escaped unless they are Markup."""
    text = _load_environment().get_template(template).render(colours=PAGE_COLOURS, **values)
    with replace_atomically(target) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@cache
def _load_environment() -> Environment:
    environment: Any = Environment(
        loader=PackageLoader("mocapfix.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    for function in (describe_change, describe_decision, describe_event, format_frame_range, format_number, format_severity):
        environment.globals[function.__name__] = function
    return environment


MAX_CAPTION_MARKERS = 12  # labels in a caption


def write_html_report(
    target: Path, report: Report, comparison: CleaningComparison, sheets: Sequence[tuple[str, bytes]] = ()
) -> None:
    """Write the HTML report of a take, with the contact sheets of its characters: their files' names, and PNG data."""
    take = comparison.input_take
    groups = {get_fault_group(fault.kind) for fault in comparison.faults.items}
    answers = (("Faults", describe_faults), ("Changes", describe_changes), ("Remaining", describe_remaining))
    notes = [("Note", note) for note in report["notes"]]
    moment, moving = _describe_worst_moment(comparison)
    review_file, name = f"{take.output_stem}.changes.yaml", take.path.name if take.path else "TAKE"
    write_page(
        target,
        "report.html.jinja",
        title=take.name,
        subtitle=_format_subtitle(report, comparison),
        report=report,
        terms=comparison.terms,
        facts=_build_facts(report, comparison),
        answers=[(question, describe(report, comparison)) for question, describe in answers] + notes,
        moment=moment,
        moving=moving,
        hands=[Figure(*each) for each in build_hand_figures(comparison, comparison.worst_moment[0])],
        change_figures=[build_change_figure(comparison, *each) for each in select_worst_changes(comparison)],
        sheets=[(name, base64.b64encode(png).decode()) for name, png in sheets],
        frame_count=take.frame_count,
        fault_rows=build_fault_rows(comparison),
        fault_legend=[each for each in FAULT_GROUPS if each[0] in groups or " " in each[0]],
        time_ticks=build_time_ticks(take),
        residual_plot=None if comparison.residual_m is None else build_residual_plot(comparison.residual_m),
        contacts=build_contact_part(report.get("contacts"), comparison.contacts, take, comparison.terms),
        take=take,
        events=comparison.events,
        change_count=len(comparison.changes),
        unchanged=[fault for fault in comparison.unchanged_faults if fault.kind not in MISSING_KINDS],
        review_file=review_file,
        review_command=shlex.join(["mocapfix", "clean", name, "--changes", review_file, "--overwrite"]),
    )


def _format_subtitle(report: Report, comparison: CleaningComparison) -> str:
    take, section = comparison.input_take, report["take"]
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    marker_set = f", marker set {section['marker_set']}" if section["marker_set"] else ""
    points = f"{section['markers']} {comparison.terms.points}"
    return f"Frames {first} to {last} at {take.rate:g} Hz ({take.frame_count / take.rate:.1f} s), {points}{marker_set}."


def _build_facts(report: Report, comparison: CleaningComparison) -> list[tuple[str, str]]:
    """Return the key numbers: value and text."""
    fill, solve, samples = report["fill"], report["solve"], comparison.terms.samples
    facts = [
        (f"{fill['missing_before'] / max(1, comparison.input_take.visible.size):.1%}", f"of the {samples} missing before"),
        (f"{fill['filled']:,}", f"{samples} filled"),
        (f"{fill['replaced']:,}", f"faulty {samples} replaced"),
        (f"{fill['left_empty']:,}", f"{samples} left {comparison.terms.left}"),
    ]
    if worst := comparison.worst_moment[1]:
        facts.insert(3, (f"{format_number(worst.predicted_mm)} mm", "predicted error of the worst change"))
    if fill["relabelled"]:
        facts.insert(1, (f"{fill['relabelled']:,}", f"{samples} relabelled"))
    if solve is not None:
        facts.append((f"{format_number(solve['marker_residual_mm']['mean'])} mm", "mean distance of markers from the body"))
        if lost := sum(solve["lost_in_sight"].values()):
            facts.append((f"{lost:,}", "frames with a part of the body lost in sight"))
    return facts


def _describe_worst_moment(comparison: CleaningComparison) -> tuple[tuple[str, Figure, Figure], dict[str, Any]]:
    """Return which moment is the worst, it before and after with the affected markers in the captions, and what is played."""
    before, after, points = comparison.input_take, comparison.cleaned_take, comparison.terms.points
    frame, worst = comparison.worst_moment
    what = "It has the most corrections." if comparison.changes else "Nothing was corrected."
    if worst:
        number = next(n for n, event in enumerate(comparison.events, 1) if worst in event)
        frames = f"frame{'s' * (worst.last > worst.first)} {format_frame_range(worst.first, worst.last)}, event {number}"
        error = f"predicted error {format_number(worst.predicted_mm)} mm (root mean square)"
        what = f"The worst change is least certain here: {worst.kind} of {join_names(worst.markers)}, {frames}, {error}."
    outcome = comparison.sample_states[frame]
    input_state = classify_input_samples(before.visible[frame], outcome)
    is_marker = ~np.isin(np.arange(len(outcome)), list(comparison.fragments_by_donor))  # a donor is a piece of another marker
    text_before = _list_markers("missing", is_marker & (input_state == SampleOutcome.EMPTY), before)
    text_before += _list_markers("faulty (red)", input_state == SampleOutcome.SUSPECT, before)
    text_before += _list_markers("under another label (violet)", input_state == SampleOutcome.RELABELLED, before)
    text_after = _list_markers("estimated (green)", find_estimated_samples(outcome), after)
    text_after += _list_markers("relabelled (violet)", outcome == SampleOutcome.RELABELLED, after)
    text_after += _list_markers("left empty", is_marker & (outcome == SampleOutcome.EMPTY), after)
    svg_before, svg_after, moving = build_moving_figures(comparison, frame, worst.markers if worst else ())
    return (
        f"Frame {before.get_frame_number(frame)}, {frame / before.rate:.2f} s after the first. {what}",
        Figure(svg_before, "Before:", text_before or f"all {points} are visible"),
        Figure(svg_after, "After:", text_after or "no corrections"),
    ), moving


def describe_event(event: Sequence[Change]) -> str:
    """Return the kinds of the changes of an event, and their markers."""
    labels = dict.fromkeys(label for change in event for label in change.markers)
    return f"{format_fault_counts(change.kind for change in event)}: {join_names(list(labels))}"


def describe_decision(change: Change) -> str:
    """Return what became of a change; one whose estimate is unreliable is not called accepted."""
    limit_mm = compute_distance_error_mm(np.array([MAX_RELIABLE_FILL_SD_M]))
    is_unreliable = change.predicted_mm is not None and change.predicted_mm > limit_mm
    made = "made, unreliable: review it" if is_unreliable else "made"
    return {"accept": made, "reject": "rejected", "keep": "kept as measured"}[change.decision]


def _list_markers(state: str, mask: Bool[np.ndarray, " M"], take: Take) -> str:
    """Return the number and the labels of the markers in a state; empty without any."""
    labels = [take.labels[m] for m in np.flatnonzero(mask)]
    more = f" and {len(labels) - MAX_CAPTION_MARKERS} more" if len(labels) > MAX_CAPTION_MARKERS else ""
    return f"{len(labels)} {state}: {', '.join(labels[:MAX_CAPTION_MARKERS])}{more}. " if labels else ""

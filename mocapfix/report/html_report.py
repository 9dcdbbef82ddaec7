"""The HTML report: a self-contained page on the faults of a take, the changes, and what remains.

Rendering of self-contained HTML pages from the templates of this package.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from jinja2 import Environment, PackageLoader, StrictUndefined

from mocapfix.io.files import replace_atomically
from mocapfix.model.take import Take
from mocapfix.report.change_list import (
    Figure,
    TableList,
    build_change_figures,
    build_change_list,
    build_left_list,
    build_unchanged_list,
    build_unfilled_list,
    describe_changes,
    describe_faults,
    describe_remaining,
)
from mocapfix.report.report import ErrorSummary, Report, SolveSection, SubjectSection
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
from mocapfix.report.stick_figures import CM_PER_M, draw_stick_figures, find_worst_frame
from mocapfix.report.terms import FAULT_GROUPS, JOINT_TERMS, format_number, get_fault_group
from mocapfix.report.timeline import (
    ContactPart,
    ResidualPlot,
    TimelineRow,
    TimeTick,
    build_contact_part,
    build_fault_rows,
    build_residual_plot,
    build_time_ticks,
)

PAGE_COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET, "blue": BLUE}


def write_page(target: Path, template: str, **values: object) -> None:
    """Render a template to a file. Values are escaped unless they are Markup.

    Raises WriteError if `target` cannot be written.
    """
    text = _load_environment().get_template(template).render(colours=PAGE_COLOURS, **values)
    with replace_atomically(target) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@cache
def _load_environment() -> Environment:
    return Environment(
        loader=PackageLoader("mocapfix.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


MAX_CAPTION_MARKERS = 12  # labels in a caption
MIN_BAR_SCALE = 1e-9  # mm or m; avoids a division by zero if all values are zero

# CSS classes and their meaning.
Legend = tuple[tuple[str, str], ...]
CHANGE_LEGEND: Legend = (
    ("was", "before"),
    ("now", "after"),
    ("kept", "unchanged"),
    ("band", "predicted 95 % interval"),
    ("when", "interval of the change"),
)
RESIDUAL_CURVE_LEGEND: Legend = (("middle", "median of the markers"), ("high", "95th percentile"))
RESIDUAL_LEGEND: Legend = (("middle", "mean"), ("high", "95th percentile, mm"))
JOINT_SD_LEGEND: Legend = (("middle", "predicted standard deviation per axis, mean"), ("high", "95th percentile, mm"))

MARKER_CURVES_CAPTION = (
    "Positions x, y (up) and z on one scale, relative to the nearest markers; other affected markers are dashed. "
    "A marker that shifted on its segment is shown by its distances from neighbouring markers."
)
JOINT_CURVES_CAPTION = (
    "Positions x, y (up) and z of the joints’ tips (the mean of their children and end sites) on one scale, relative to the tip "
    "of the parent joint; other affected joints are dashed."
)


@dataclass(frozen=True)
class BarRow:
    """A row of bars: name, bars (CSS class and share of the width, the longest first) and value."""

    name: str
    shares: tuple[tuple[str, float], ...]
    value: str


@dataclass(frozen=True)
class WorstFrame:
    """The frame with the most corrections, before and after."""

    text: str
    figures: tuple[Figure, Figure]


@dataclass(frozen=True)
class SolvePart:
    """Residuals by marker, uncertainty by joint, and the solver's status."""

    residual_legend: Legend
    residual_bars: list[BarRow]
    joint_legend: Legend
    joint_bars: list[BarRow]
    status_rows: list[tuple[str, str]]
    text: str


@dataclass(frozen=True)
class SubjectPart:
    """Bone lengths."""

    text: str
    bars: list[BarRow]


@dataclass(frozen=True)
class ReviewPart:
    """How a change is reverted: the review file, the meaning of "keep", and the command."""

    file: str
    keep: str
    command: str


@dataclass(frozen=True)
class ReportPage:
    """Values of the template."""

    facts: list[tuple[str, str]]
    answers: list[tuple[str, str]]
    worst_frame: WorstFrame
    change_figures: list[Figure]
    change_legend: Legend
    curves_caption: str
    frame_count: int
    fault_rows: list[TimelineRow]
    fault_legend: Legend
    time_ticks: list[TimeTick]
    residual_plot: ResidualPlot | None
    residual_curve_legend: Legend
    contacts: ContactPart | None
    left_by_marker: TableList | None
    unfilled: TableList | None
    unchanged: TableList | None
    changes: TableList | None
    review: ReviewPart
    solve: SolvePart | None
    subject: SubjectPart | None
    stage_rows: list[tuple[str, str]]


def write_html_report(target: Path, report: Report, comparison: CleaningComparison) -> None:
    """Write the HTML report of a take.

    Raises WriteError if `target` cannot be written.
    """
    write_page(
        target,
        "report.html.jinja",
        title=comparison.input_take.name,
        subtitle=_format_subtitle(report, comparison),
        page=build_report_page(report, comparison),
    )


def build_report_page(report: Report, comparison: CleaningComparison) -> ReportPage:
    """Return the values of the template."""
    is_joints = comparison.terms is JOINT_TERMS
    groups = {get_fault_group(fault.kind) for fault in comparison.faults.items}
    return ReportPage(
        facts=_build_facts(report, comparison),
        answers=[
            ("Faults", describe_faults(report, comparison)),
            ("Changes", describe_changes(report, comparison)),
            ("Remaining", describe_remaining(report, comparison)),
            *(("Note", note) for note in report["notes"]),
        ],
        worst_frame=_build_worst_frame(comparison),
        change_figures=build_change_figures(comparison),
        change_legend=CHANGE_LEGEND,
        curves_caption=JOINT_CURVES_CAPTION if is_joints else MARKER_CURVES_CAPTION,
        frame_count=comparison.input_take.frame_count,
        fault_rows=build_fault_rows(comparison),
        fault_legend=tuple(each for each in FAULT_GROUPS if each[0] in groups or " " in each[0]),
        time_ticks=build_time_ticks(comparison.input_take),
        residual_plot=None if comparison.residual_m is None else build_residual_plot(comparison.residual_m),
        residual_curve_legend=RESIDUAL_CURVE_LEGEND,
        contacts=build_contact_part(report.get("contacts"), comparison.contacts, comparison.input_take, comparison.terms),
        left_by_marker=build_left_list(report["fill"]["left_by_marker"], comparison),
        unfilled=build_unfilled_list(report["fill"]["unfilled"], comparison),
        unchanged=build_unchanged_list(comparison),
        changes=build_change_list(comparison),
        review=_build_review_part(comparison),
        solve=None if report["solve"] is None else _build_solve_part(report["solve"]),
        subject=None if report["subject"] is None else _build_subject_part(report["subject"]),
        stage_rows=[(stage, f"{seconds:.2f} s") for stage, seconds in report["seconds"].items()],
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
        (f"{fill['left_empty']:,}", f"{samples} left empty"),
    ]
    if fill["relabelled"]:
        facts.insert(1, (f"{fill['relabelled']:,}", f"{samples} relabelled"))
    if solve is not None:
        facts.append((f"{format_number(solve['marker_residual_mm']['mean'])} mm", "mean distance of markers from the body"))
        if lost := sum(solve["lost_in_sight"].values()):
            facts.append((f"{lost:,}", "frames with a part of the body lost in sight"))
    return facts


def _build_worst_frame(comparison: CleaningComparison) -> WorstFrame:
    """Return the stick figures of the frame with the most corrections, with the affected markers in their captions."""
    before, after, points = comparison.input_take, comparison.cleaned_take, comparison.terms.points
    frame = find_worst_frame(comparison.sample_states, comparison.joint_position_world)
    outcome = comparison.sample_states[frame]
    input_state = classify_input_samples(before.visible[frame], outcome)
    text_before = (
        _list_markers("missing", input_state == SampleOutcome.EMPTY, before)
        + _list_markers("faulty (red)", input_state == SampleOutcome.SUSPECT, before)
        + _list_markers("under another label (violet)", input_state == SampleOutcome.RELABELLED, before)
    )
    text_after = (
        _list_markers("estimated (green)", find_estimated_samples(outcome), after)
        + _list_markers("relabelled (violet)", outcome == SampleOutcome.RELABELLED, after)
        + _list_markers("left empty", outcome == SampleOutcome.EMPTY, after)
    )
    svg_before, svg_after = draw_stick_figures(comparison, frame)
    figures = (
        Figure(svg_before, "Before:", text_before or f"all {points} are visible"),
        Figure(svg_after, "After:", text_after or "no corrections"),
    )
    return WorstFrame(f"Frame {before.get_frame_number(frame)}, {frame / before.rate:.2f} s after the first.", figures)


def _list_markers(state: str, mask: Bool[np.ndarray, " M"], take: Take) -> str:
    """Return the number and the labels of the markers in a state; empty without any."""
    labels = [take.labels[m] for m in np.flatnonzero(mask)]
    more = f" and {len(labels) - MAX_CAPTION_MARKERS} more" if len(labels) > MAX_CAPTION_MARKERS else ""
    return f"{len(labels)} {state}: {', '.join(labels[:MAX_CAPTION_MARKERS])}{more}. " if labels else ""


def _build_review_part(comparison: CleaningComparison) -> ReviewPart:
    take = comparison.input_take
    review_file = f"{take.output_stem}.changes.yaml"
    keep = f"leave the {comparison.terms.samples} as they are and use them in the solve"
    name = take.path.name if take.path else "TAKE"
    return ReviewPart(review_file, keep, shlex.join(["mocapfix", "clean", name, "--changes", review_file, "--overwrite"]))


def _build_solve_part(solve: SolveSection) -> SolvePart:
    iterations = format_number(solve["iterations_mean"])
    return SolvePart(
        residual_legend=RESIDUAL_LEGEND,
        residual_bars=_build_error_bars(solve["marker_residual_mm"]["by_marker"]),
        joint_legend=JOINT_SD_LEGEND,
        joint_bars=_build_error_bars(solve["joint_deviation_mm"]),
        status_rows=[(f"{count:,}", text) for text, count in solve["status"].items() if count],
        text=f"{iterations} iterations per frame on average; initial poses: {solve['start']}. {_describe_prior(solve)} "
        f"Joints that the markers show: {len(solve['solved_joints'])} of {len(solve['joint_deviation_mm'])}.",
    )


def _describe_prior(solve: SolveSection) -> str:
    """Return a sentence on what occluded limbs are estimated from."""
    text = "Occluded limbs are estimated from the motion in the rest of the take"
    if (prior := solve["prior"]) is None:
        return f"{text}."
    scale = "" if prior["scale"] == 1 else f", standard deviations multiplied by {prior['scale']:g}"
    return f"{text} and the pose prior {prior['name']}{scale}."


def _build_error_bars(summaries: Mapping[str, ErrorSummary]) -> list[BarRow]:
    """Return rows of mean and 95th percentile, the largest mean first; rows without finite values are left out."""
    known: list[tuple[str, float, float]] = []
    for name, summary in summaries.items():
        mean, p95 = summary["mean"], summary["p95"]
        if mean is not None and p95 is not None and np.isfinite(mean):
            known.append((name, mean, p95))
    limit_mm = max([p95 for _, _, p95 in known] + [MIN_BAR_SCALE])
    return [
        BarRow(name, (("high", p95 / limit_mm), ("middle", mean / limit_mm)), f"{format_number(mean)} / {format_number(p95)}")
        for name, mean, p95 in sorted(known, key=lambda item: -item[1])
    ]


def _build_subject_part(subject: SubjectSection) -> SubjectPart:
    limit_m = max([*subject["bones_m"].values(), MIN_BAR_SCALE])
    bars = [
        BarRow(name, (("high", length / limit_m),), f"{format_number(CM_PER_M * length)} cm")
        for name, length in subject["bones_m"].items()
        if length > 0
    ]
    source = f"calibrated on {subject['frames']:,} frames" if subject["frames"] else "of a nominal body"
    return SubjectPart(f"Bone lengths, {source}; marker set {subject['marker_set']}.", bars)

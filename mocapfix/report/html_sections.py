"""The sections of the report page, each as HTML, or "" where there is nothing to say; all text from outside is escaped."""

from html import escape

import numpy as np

from mocapfix.report import stick_figures, summary, timeline
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.html_elements import render_bars, render_legend, render_table
from mocapfix.report.sample_states import (
    SAMPLE_EMPTY,
    SAMPLE_RELABELLED,
    SAMPLE_SUSPECT,
    classify_input_samples,
    find_estimated_samples,
)
from mocapfix.report.summary import format_number
from mocapfix.report.terms import FAULT_GROUPS, get_fault_group, use_joint_terms
from mocapfix.take import Take

MAX_CAPTION_MARKERS = 12  # markers named below a picture

# Classes of the page's style sheet, and what they mean.
RESIDUAL_CURVE_LEGEND = (("middle", "median of the markers"), ("high", "95th percentile"))
RESIDUAL_LEGEND = (("middle", "mean"), ("high", "95th percentile, mm"))
JOINT_SD_LEGEND = (("middle", "predicted error per axis, mean"), ("high", "95th percentile, mm"))


def render_overview(report: dict, comparison: CleaningComparison) -> str:
    """What was wrong, what was done, what was left, in figures and in sentences."""
    fill, solve = report["fill"], report["solve"]
    values = [
        (f"{fill['missing_before'] / max(1, comparison.input_take.visible.size):.1%}", "of the samples missing before"),
        (f"{fill['filled']:,}", "samples filled"),
        (f"{fill['mended']:,}", "faulty samples replaced"),
        (f"{fill['left_empty']:,}", "samples left empty"),
    ]
    if fill["relabelled"]:
        values.insert(1, (f"{fill['relabelled']:,}", "samples put under their own labels"))
    if solve is not None:
        values.append((f"{format_number(solve['marker_residual_mm']['mean'])} mm", "from markers to body, mean"))
    facts = "".join(
        f"<div><b>{value}</b><small>{use_joint_terms(what, comparison.input_take)}</small></div>" for value, what in values
    )
    answers = [
        ("What was wrong", summary.describe_faults(report, comparison)),
        ("What was done", summary.describe_changes(report, comparison)),
    ]
    answers += [
        ("What was left", summary.describe_remaining(report, comparison)),
        *(("To know", note) for note in report["notes"]),
    ]
    sentences = "".join(f"<dt>{question}</dt><dd>{escape(answer)}</dd>" for question, answer in answers)
    return f'<div class="facts">{facts}</div><dl class="summary">{sentences}</dl>'


def render_worst_frame(comparison: CleaningComparison) -> str:
    """The frame in which most was mended, before and after."""
    before, after = comparison.input_take, comparison.cleaned_take
    t = stick_figures.find_worst_frame(comparison.sample_states, comparison.joint_position_world)
    pictures = stick_figures.draw_stick_figures(comparison, t)
    state, was = comparison.sample_states[t], classify_input_samples(before.visible[t], comparison.sample_states[t])
    words = [
        _list_markers("missing", was == SAMPLE_EMPTY, before)
        + _list_markers("judged faulty (red)", was == SAMPLE_SUSPECT, before)
        + _list_markers("under another label (violet)", was == SAMPLE_RELABELLED, before)
        or use_joint_terms("all markers are there", before),
        _list_markers("mended (green)", find_estimated_samples(state), after)
        + _list_markers("under their own labels (violet)", state == SAMPLE_RELABELLED, after)
        + _list_markers("left empty", state == SAMPLE_EMPTY, after)
        or "nothing to mend",
    ]
    parts = "".join(
        f"<figure>{picture}<figcaption><b>{name}</b> {escape(text)}</figcaption></figure>"
        for name, picture, text in zip(("Before:", "After:"), pictures, words, strict=True)
    )
    frame = f"Frame {before.get_frame_number(t)}, {t / before.rate:.2f} s from the first"
    return f'<h2>The worst moment</h2><p class="soft">{frame}.</p><div class="figures">{parts}</div>'


def _list_markers(what: str, mask: np.ndarray, take: Take) -> str:
    labels = [take.labels[m] for m in np.flatnonzero(mask)]
    more = f" and {len(labels) - MAX_CAPTION_MARKERS} more" if len(labels) > MAX_CAPTION_MARKERS else ""
    return f"{len(labels)} {what}: {', '.join(labels[:MAX_CAPTION_MARKERS])}{more}. " if labels else ""


def render_timeline(comparison: CleaningComparison) -> str:
    """When which marker failed, and how far the markers were from the body meanwhile."""
    rows, error, text = timeline.render_fault_rows(comparison), comparison.residual_m, ""
    if rows:
        there = {get_fault_group(fault.kind) for fault in comparison.faults.items}
        groups = [each for each in FAULT_GROUPS if each[0] in there or " " in each[0]]
        text += f"<h2>Faults over time</h2>{render_legend((name, use_joint_terms(said, comparison.input_take)) for name, said in groups)}{rows}"
    if error is not None and (curves := timeline.render_residual_curves(error)):
        axis = timeline.render_time_axis(comparison.input_take)
        text += f"<h2>Distance of the markers from the body</h2>{render_legend(RESIDUAL_CURVE_LEGEND)}{curves}{axis}"
    return text


def render_residuals(report: dict) -> str:
    """How far each marker was seen from the body, how surely the joints are known, and how the solve of each frame ended."""
    if (solve := report["solve"]) is None:
        return ""
    markers, joints = (
        _render_error_bars(solve["marker_residual_mm"]["by_marker"]),
        _render_error_bars(solve["joint_deviation_mm"]),
    )
    status = render_table(("Frames", "How their solve ended"), [(f"{n:,}", text) for text, n in solve["status"].items() if n])
    steps = f"{format_number(solve['iterations_mean'])} iterations a frame on average, from the start {escape(solve['start'])}."
    iterations = f'<p class="soft">{steps} {_describe_prior(solve)}</p>'
    return (
        f"<h2>Each marker’s distance from the body</h2>{render_legend(RESIDUAL_LEGEND)}{markers}"
        f"<h2>How surely each joint is known</h2>{render_legend(JOINT_SD_LEGEND)}{joints}<h2>The solve</h2>{status}{iterations}"
    )


def _describe_prior(solve: dict) -> str:
    """What limbs that were lost were put back from."""
    if (prior := solve["prior"]) is None:
        return "Lost limbs come from the take’s own motion."
    less = "" if prior["scale"] == 1 else f", its standard deviations times {prior['scale']:g}"
    return f"Lost limbs come from the take’s own motion and from people’s poses (the prior {escape(prior['name'])}{less})."


def _render_error_bars(summaries: dict[str, dict]) -> str:
    """Bars of what has a mean and a 95th percentile, the largest first."""
    known = {name: value for name, value in summaries.items() if value["mean"] is not None and np.isfinite(value["mean"])}
    top = max([value["p95"] for value in known.values()] + [1e-9])
    rows = []
    for name, value in sorted(known.items(), key=lambda item: -item[1]["mean"]):
        mean, high = value["mean"], value["p95"]
        rows.append((name, (("high", high / top), ("middle", mean / top)), f"{format_number(mean)} / {format_number(high)}"))
    return render_bars(rows)


def render_subject(report: dict) -> str:
    """The person's bones."""
    if (person := report["subject"]) is None:
        return ""
    top = max([*person["bones_m"].values(), 1e-9])
    rows = [(name, (("high", m / top),), f"{format_number(100 * m)} cm") for name, m in person["bones_m"].items() if m > 0]
    source = f"calibrated on {person['frames']:,} frames" if person["frames"] else "of a nominal body"
    words = f"Bone lengths, {source}; marker set {escape(person['marker_set'])}."
    return f'<h2>The person</h2><p class="soft">{words}</p>{render_bars(rows)}'


def render_stage_times(report: dict) -> str:
    """Where the time went."""
    rows = [(stage, f"{s:.2f} s") for stage, s in report["seconds"].items()]
    return f"<h2>Time spent</h2>{render_table(('Stage', 'Seconds'), rows)}"

"""What the HTML report says and shows of the changes: a summary, and figures of the largest changes.

A figure has the curves of the marker, one strip per axis on a common scale, input in red, result in green. They are marker
positions over the frames of the change and a margin on both sides, relative to the nearest markers, which removes the motion of
the body. A marker that shifted on its segment is shown by its distances from the markers that reveal the shift best; distances do
not depend on the rotation of the segment. The tip of a joint is shown relative to the tip of its parent.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from markupsafe import Markup

from mocapfix.errors import join_names, join_words
from mocapfix.model.changes import Change
from mocapfix.model.faults import LABEL_KINDS, MISSING_KINDS, Fault, Fragment, MarkerShift
from mocapfix.model.take import Take
from mocapfix.report.report import Report
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.terms import JOINT_TERMS, format_fault_counts, format_frame_range, format_number
from mocapfix.report.timeline import compute_round_step
from mocapfix.stats.sequences import find_runs

CURVE_MARGIN_S = 0.5  # shown before and after the change
MAX_CURVE_POINTS = 150  # per curve over the whole figure, and as many again over the change
REFERENCE_MARKER_COUNT = 3  # markers whose mean is the origin
MAX_REFERENCE_DISTANCE_M = 0.6  # median distance of a reference marker
REFERENCE_CANDIDATE_COUNT = 10  # nearest markers among which those are chosen that reveal a shift best
MAX_CURVE_MARKERS = 3  # markers in a figure
MAX_LABEL_CURVE_DURATION_S = 5.0  # shown of a label exchange
BAND_SD_MULTIPLE = 2  # half-width of the uncertainty band in standard deviations: about 95 %
MIN_SCATTER_MM = 1e-9  # avoids a division by zero for distances without scatter


@dataclass(frozen=True)
class MarkerCurve:
    """One marker over the frames of a figure."""

    kind: Literal["kept", "was", "now"]  # "was": before the change; "now": after it; "kept": unchanged
    values_mm: Float[np.ndarray, "N S"]  # one column per axis, NaN where the curve is interrupted
    rank: int = 0  # 0 for the marker of the fault, 1 and 2 for other affected markers


@dataclass(frozen=True)
class ChangeCurves:
    """All curves of a figure."""

    frames: Int[np.ndarray, " N"]  # frame indices of the values
    axis_names: tuple[str, ...]  # S names: the coordinates, or the markers to which distances are measured
    reference_labels: tuple[str, ...]  # markers whose mean is the origin; empty if positions are in the world
    curves: tuple[MarkerCurve, ...]  # one or more curves per marker
    band_mm: Float[np.ndarray, "N S 2"]  # lower and upper edge of the uncertainty band, NaN where nothing was estimated


def build_change_curves(comparison: CleaningComparison, fault: Fault) -> ChangeCurves:
    """Return the curves of the markers that a fault affects, before and after cleaning."""
    before, after = comparison.input_take, comparison.cleaned_take
    frames, affected = _select_frames(fault, after), comparison.find_affected_trajectories(fault)
    candidates = _find_reference_markers(comparison, affected, frames)
    if isinstance(fault, MarkerShift) and candidates:
        return _build_distance_curves(after, fault, frames, candidates[:REFERENCE_CANDIDATE_COUNT])
    references = candidates[:REFERENCE_MARKER_COUNT]
    origin = after.markers[frames][:, references].mean(axis=1) if references else np.zeros((len(frames), 3))
    curves: list[MarkerCurve] = []
    for rank, m in enumerate(affected[:MAX_CURVE_MARKERS]):
        before_mm, after_mm = (1e3 * (_get_position(take, m)[frames] - origin) for take in (before, after))
        curves += _split_by_change(before_mm, after_mm, rank)
    position_mm = 1e3 * (_get_position(after, affected[0])[frames] - origin)
    sd_m = np.full(len(frames), np.nan)
    if after.sample_sd is not None and affected[0] < len(after.labels):
        sd_m = after.sample_sd[frames, affected[0]]
    half_width_mm = BAND_SD_MULTIPLE * 1e3 * sd_m[:, None]
    band_mm = np.stack([position_mm - half_width_mm, position_mm + half_width_mm], axis=-1)
    return ChangeCurves(frames, ("x", "y", "z"), tuple(after.labels[m] for m in references), tuple(curves), band_mm)


def _select_frames(fault: Fault, take: Take) -> Int[np.ndarray, " N"]:
    """Return the frames of a figure: all frames of a short change, a regular selection of a long one."""
    margin = max(2, round(CURVE_MARGIN_S * take.rate))
    last = fault.last
    if fault.kind in LABEL_KINDS:
        last = min(last, fault.first + round(MAX_LABEL_CURVE_DURATION_S * take.rate))
    begin = 0 if isinstance(fault, MarkerShift) else max(0, fault.first - margin)
    end = min(take.frame_count - 1, last + margin)
    of_change = np.linspace(max(begin, fault.first - 1), min(end, last + 1), MAX_CURVE_POINTS)
    return np.unique(np.concatenate([np.linspace(begin, end, MAX_CURVE_POINTS), of_change]).round().astype(int))


def _find_reference_markers(comparison: CleaningComparison, affected: Sequence[int], frames: Int[np.ndarray, " N"]) -> list[int]:
    """Return the unaffected markers near the first affected one that are visible whenever it is, the nearest first.

    The only reference of a joint is its parent.
    """
    take = comparison.cleaned_take
    if comparison.terms == JOINT_TERMS and comparison.skeleton is not None:
        parent = [*comparison.skeleton.parents, -1][affected[0]]
        return [int(parent)] if parent >= 0 else []
    position = _get_position(take, affected[0])[frames]
    visible = ~np.isnan(position[:, 0])
    if not visible.any():
        return []
    distances = np.linalg.norm(take.markers[frames[visible]] - position[visible, None], axis=-1)
    median_m = np.median(distances, axis=0)  # NaN if the marker is missing in a frame
    median_m[[m for m in affected if m < len(take.labels)]] = np.nan
    return [int(m) for m in np.argsort(median_m) if median_m[m] < MAX_REFERENCE_DISTANCE_M]


def _get_position(take: Take, index: int) -> Float[np.ndarray, "T 3"]:
    """Return the position of a marker or, from the number of markers on, of an unlabelled trajectory."""
    if index < len(take.labels) or take.unlabelled is None:
        return take.markers[:, index]
    return take.unlabelled.markers[:, index - len(take.labels)]


def _split_by_change(before_mm: Float[np.ndarray, "N 3"], after_mm: Float[np.ndarray, "N 3"], rank: int) -> list[MarkerCurve]:
    """Return the unchanged part of a curve, and the changed before and after with the adjacent unchanged samples."""
    changed = ~((before_mm == after_mm) | np.isnan(before_mm) & np.isnan(after_mm)).all(axis=1)
    extended = changed.copy()
    extended[1:] |= changed[:-1]
    extended[:-1] |= changed[1:]
    return [
        MarkerCurve("kept", _mask_values(~changed, after_mm), rank),
        MarkerCurve("was", _mask_values(extended, before_mm), rank),
        MarkerCurve("now", _mask_values(extended, after_mm), rank),
    ]


def _mask_values(mask: Bool[np.ndarray, " N"], values: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "N S"]:
    return np.where(mask[:, None], values, np.nan)


def _build_distance_curves(
    take: Take, fault: MarkerShift, frames: Int[np.ndarray, " N"], candidates: Sequence[int]
) -> ChangeCurves:
    """Return the distances of a shifted marker from its neighbours: before, during and after the shift."""
    offset = take.markers[frames][:, candidates] - take.markers[frames, fault.marker][:, None]
    distance_mm = 1e3 * np.linalg.norm(offset, axis=-1)
    before, after = frames < fault.first, frames >= fault.settled_frame
    contrast = np.zeros(len(candidates))
    if (visible := ~np.isnan(distance_mm[:, 0]))[before].any() and visible[after].any():
        old, new = distance_mm[before & visible], distance_mm[after & visible]
        contrast = abs(new.mean(axis=0) - old.mean(axis=0)) / (old.std(axis=0) + new.std(axis=0) + MIN_SCATTER_MM)
    best = np.argsort(-contrast, kind="stable")[:REFERENCE_MARKER_COUNT]
    distance_mm, names = distance_mm[:, best], tuple(take.bare_labels[candidates[n]] for n in best)
    curves = (
        MarkerCurve("was", _mask_values(before, distance_mm)),
        MarkerCurve("kept", _mask_values(~before & ~after, distance_mm)),
        MarkerCurve("now", _mask_values(after, distance_mm)),
    )
    return ChangeCurves(frames, names, (), curves, np.full((*distance_mm.shape, 2), np.nan))


CHANGE_FIGURE_WIDTH = 300  # of the curves
CHANGE_FIGURE_HEIGHT = 180
LEFT_MARGIN = 40  # for the names of the axes
RIGHT_MARGIN = 20  # for the scale bar
BOTTOM_MARGIN = 14  # for the frame numbers
AXIS_SPACING = 8
MAX_AXIS_NAME_LENGTH = 7  # letters that fit into the left margin
MIN_AXIS_RANGE_MM = 10.0  # smaller ranges are enlarged, so that noise does not look like motion
DIGIT_WIDTH = 7
SCALE_BAR_SHARE = 6  # the scale bar takes about one part in so many of the height

CURVE_ORDER = ("was", "kept", "now")  # later curves are drawn over earlier ones


def draw_change_figure(curves: ChangeCurves, first: int, last: int, first_frame: int) -> Markup:
    """Return the SVG of a change over the frame indices first..last; `first_frame` is the file's number of frame 0."""
    low, high = _compute_axis_ranges(curves)
    scale = float((CHANGE_FIGURE_HEIGHT - AXIS_SPACING * (len(low) - 1)) / (high - low).sum())
    tops = np.concatenate([[0], np.cumsum((high - low) * scale + AXIS_SPACING)[:-1]])
    frame_span = max(1, curves.frames[-1] - curves.frames[0])

    def compute_y(values_mm: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "N S"]:
        return tops + (high - values_mm) * scale

    x = CHANGE_FIGURE_WIDTH * (curves.frames - curves.frames[0]) / frame_span
    last = min(last, int(curves.frames[-1]))
    left, right = (CHANGE_FIGURE_WIDTH * (t - curves.frames[0]) / frame_span for t in (first, last))
    size = f'x="{left - 1:.1f}" y="-4" width="{right - left + 2:.1f}" height="{CHANGE_FIGURE_HEIGHT + 8}"'
    content = f'<rect class="when" {size}/>'
    content += _draw_band(x, compute_y(curves.band_mm[..., 0]), compute_y(curves.band_mm[..., 1]))
    ordered = sorted(curves.curves, key=lambda curve: CURVE_ORDER.index(curve.kind))
    content += "".join(_draw_curve(curve, x, compute_y(curve.values_mm)) for curve in ordered)
    content += "".join(
        f'<text x="-6" y="{top + (h - w) * scale / 2 + 3:.1f}" text-anchor="end">{escape(name[:MAX_AXIS_NAME_LENGTH])}</text>'
        for name, top, w, h in zip(curves.axis_names, tops, low, high, strict=True)
    )
    bar_mm, bar_x = compute_round_step(CHANGE_FIGURE_HEIGHT / SCALE_BAR_SHARE / scale), CHANGE_FIGURE_WIDTH + 5
    content += f'<path class="bar" d="M{bar_x} {CHANGE_FIGURE_HEIGHT}v{-bar_mm * scale:.1f}"/>'
    content += f'<text transform="translate({bar_x + 10} {CHANGE_FIGURE_HEIGHT}) rotate(-90)">{bar_mm:g} mm</text>'
    content += _draw_frame_numbers(left, right, first_frame + first, first_frame + last)
    width = LEFT_MARGIN + CHANGE_FIGURE_WIDTH + RIGHT_MARGIN
    box = f"{-LEFT_MARGIN} -6 {width} {CHANGE_FIGURE_HEIGHT + BOTTOM_MARGIN + 12}"
    return Markup(f'<svg class="change" viewBox="{box}" role="img" aria-label="before and after">{content}</svg>')


def _compute_axis_ranges(curves: ChangeCurves) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the lower and upper limit of each axis in millimetres."""
    values = np.concatenate([*(curve.values_mm for curve in curves.curves), curves.band_mm[..., 0], curves.band_mm[..., 1]])
    values = np.where(np.isfinite(values).any(axis=0), values, 0.0)
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    extra = np.maximum(0, MIN_AXIS_RANGE_MM - (high - low)) / 2
    return low - extra, high + extra


def _draw_curve(curve: MarkerCurve, x: Float[np.ndarray, " N"], y: Float[np.ndarray, "N S"]) -> str:
    """Return one SVG path; a sample without neighbours is a dot."""
    lines = "".join(
        "M" + "L".join(f"{x[i]:.1f} {y[i, s]:.1f}" for i in range(first, last + 1)) + ("h0" if first == last else "")
        for s in range(y.shape[1])
        for first, last in find_runs(np.isfinite(y[:, s]))
    )
    return f'<path class="{curve.kind} rank{curve.rank}" d="{lines}"/>' if lines else ""


def _draw_band(x: Float[np.ndarray, " N"], low: Float[np.ndarray, "N S"], high: Float[np.ndarray, "N S"]) -> str:
    """Return the SVG path of the area between two curves."""
    areas = ""
    for s in range(low.shape[1]):
        for first, last in find_runs(np.isfinite(low[:, s])):
            forward = [f"{x[i]:.1f} {high[i, s]:.1f}" for i in range(first, last + 1)]
            backward = [f"{x[i]:.1f} {low[i, s]:.1f}" for i in range(last, first - 1, -1)]
            areas += "M" + "L".join(forward + backward) + "Z"
    return f'<path class="band" d="{areas}"/>' if areas else ""


def _draw_frame_numbers(left: float, right: float, first: int, last: int) -> str:
    """Return the file's frame numbers at both ends of the change, as one range if they would overlap."""
    width = DIGIT_WIDTH * len(f"{last}")
    ends = ((left, f"{first}"), (right, f"{last}"))
    if right - left <= width:
        ends = (((left + right) / 2, format_frame_range(first, last)),)
    texts = ((np.clip(x, width / 2, CHANGE_FIGURE_WIDTH - width / 2), text) for x, text in ends)
    y = CHANGE_FIGURE_HEIGHT + BOTTOM_MARGIN
    return "".join(f'<text x="{x:.1f}" y="{y}" text-anchor="middle">{text}</text>' for x, text in texts)


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
    decisions = Counter(change["decision"] for change in report["changes"])
    names = {"reject": "rejected", "keep": "kept as measured"}
    refused = [f"{decisions[decision]:,} {name}" for decision, name in names.items() if decisions[decision]]
    declined = f" Declined in review: {join_words(refused)}." if refused else ""
    if not parts:
        return f"No changes: all {terms.samples} are as {terms.measured}.{declined}"
    text = f"{join_words(parts)}; every other {terms.sample} is as {terms.measured}.{declined}"
    if not fill["filled"] and not fill["replaced"]:
        return text
    if terms == JOINT_TERMS:
        return f"{text} The method is listed with each change below."
    if report["subject"] is None or report["solve"] is None:
        return f"{text} No body was used: the estimates come from the other markers and the markers’ own trajectories."
    residual = report["solve"]["marker_residual_mm"]
    mean, p95 = format_number(residual["mean"]), format_number(residual["p95"])
    text += " The estimates come from the solved body and the other markers; the method is listed with each change."
    return f"{text} The body's mean distance from the markers is {mean} mm (95th percentile {p95} mm)."


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
    lost = report["solve"]["lost_in_sight"] if report["solve"] else {}
    parts = [f"{name} ({count:,} frame{'' if count == 1 else 's'})" for name, count in lost.items()]
    return text + f" Lost by the solved body although their markers are seen: {join_words(parts)}." * bool(parts)


def format_severity(fault: Fault) -> str:
    """Return the severity of a fault with its unit, a dash if it is unknown."""
    value, unit = 1e3 * fault.severity, "mm"
    if fault.severity_unit == "rad":
        value, unit = float(np.degrees(fault.severity)), "degrees"
    return f"{format_number(value, 0)} {unit}" if np.isfinite(value) else format_number(None)


MAX_CHANGE_FIGURES = 12
TRAVEL_SEVERITY_KINDS = (*MISSING_KINDS, "segment lost", "computed")  # whose severity is the distance travelled


@dataclass(frozen=True)
class Figure:
    """An SVG with its caption: a name in bold and a text."""

    svg: Markup
    name: str
    text: str


def select_worst_changes(comparison: CleaningComparison) -> list[tuple[Change, Fault]]:
    """Return at most MAX_CHANGE_FIGURES applied changes, the worst first: the worst of each kind, of each event, then others.

    The worst has the largest product of duration and the sum of the errors, before and predicted; 1 rad counts as 1 m.
    """

    def compute_weight(pair: tuple[Change, Fault]) -> float:
        change, fault = pair
        error_before = 0.0 if fault.kind in TRAVEL_SEVERITY_KINDS or np.isnan(fault.severity) else fault.severity
        return (fault.last - fault.first + 1) * (error_before + (change.predicted_mm or 0.0) / 1e3)

    ordered = sorted(comparison.applied_changes, key=compute_weight, reverse=True)
    event_of = {id(change): n for n, event in enumerate(comparison.events) for change in event}
    first_of: dict[str | int, int] = {}
    for keys in ([change.kind for change, _ in ordered], [event_of[id(change)] for change, _ in ordered]):
        for n, key in enumerate(keys):
            first_of.setdefault(key, n)
    chosen = list(dict.fromkeys((*first_of.values(), *range(len(ordered)))))
    return [ordered[n] for n in sorted(chosen[:MAX_CHANGE_FIGURES])]


def build_change_figure(comparison: CleaningComparison, change: Change, fault: Fault) -> Figure:
    curves = build_change_curves(comparison, fault)
    svg = draw_change_figure(curves, fault.first, fault.last, comparison.input_take.first_frame)
    frames = f"frame{'s' if change.last > change.first else ''} {format_frame_range(change.first, change.last)}"
    sentences = [describe_change(change)]
    if change.predicted_mm is not None:
        sentences.append(f"Predicted error {format_number(change.predicted_mm)} mm.")
    if curves.reference_labels:
        sentences.append(f"Relative to {', '.join(curves.reference_labels)}.")
    if curves.frames[-1] < fault.last:
        sentences.append("Only the beginning is shown.")
    return Figure(svg, f"{change.kind}: {', '.join(change.markers)}, {frames}.", " ".join(sentences))


def describe_change(change: Change) -> str:
    """Return why the change was made, and how."""
    method = f"{change.method[:1].upper()}{change.method[1:]}" if change.decision == "accept" else "Not applied"
    return f"{change.why} {method}."

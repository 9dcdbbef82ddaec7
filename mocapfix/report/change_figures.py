"""SVG figure of a change: the curves of its marker, one strip per axis on a common scale, input in red, result in green.

The curves are marker positions over the frames of the change and a margin on both sides. Positions are relative to the nearest
markers, which removes the motion of the body. A marker that shifted on its segment is shown by its distances from the markers
that reveal the shift best; distances do not depend on the rotation of the segment. The tip of a joint is shown relative to the
tip of its parent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from markupsafe import Markup

from mocapfix.faults import LABEL_KINDS, Fault, MarkerShift
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.terms import JOINT_TERMS, format_frame_range
from mocapfix.report.timeline import compute_round_step
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

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
    """One marker over the frames of a figure.

    kind       "was": before the change; "now": after it; "kept": unchanged
    values_mm  (N, S) one column per axis, NaN where the curve is interrupted
    rank       0 for the marker of the fault, 1 and 2 for other affected markers
    """

    kind: Literal["kept", "was", "now"]
    values_mm: Float[np.ndarray, "N S"]
    rank: int = 0


@dataclass(frozen=True)
class ChangeCurves:
    """All curves of a figure.

    frames            (N,) frame indices of the values
    axis_names        S names: the coordinates, or the markers to which distances are measured
    reference_labels  markers whose mean is the origin; empty if positions are in the world
    curves            one or more curves per marker
    band_mm           (N, S, 2) lower and upper edge of the uncertainty band, NaN where nothing was estimated
    """

    frames: Int[np.ndarray, " N"]
    axis_names: tuple[str, ...]
    reference_labels: tuple[str, ...]
    curves: tuple[MarkerCurve, ...]
    band_mm: Float[np.ndarray, "N S 2"]


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
    half_width_mm = BAND_SD_MULTIPLE * 1e3 * _get_fill_sd(after, affected[0])[frames, None]
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
    if comparison.terms is JOINT_TERMS and comparison.skeleton is not None:
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


def _get_fill_sd(take: Take, index: int) -> Float[np.ndarray, " T"]:
    """Return the predicted standard deviation of the samples in metres, NaN where they were measured."""
    if take.sample_sd is None or index >= len(take.labels):
        return np.full(take.frame_count, np.nan)
    return take.sample_sd[:, index]


def _split_by_change(before_mm: Float[np.ndarray, "N 3"], after_mm: Float[np.ndarray, "N 3"], rank: int) -> list[MarkerCurve]:
    """Return the unchanged part of a curve, the changed part before and the changed part after.

    The changed parts extend to the adjacent unchanged samples.
    """
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
    scale = (CHANGE_FIGURE_HEIGHT - AXIS_SPACING * (len(low) - 1)) / (high - low).sum()
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
    content += _draw_scale_bar(scale) + _draw_frame_numbers(left, right, first_frame + first, first_frame + last)
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


def _draw_scale_bar(scale: float) -> str:
    """Return a vertical bar of a round number of millimetres; `scale` is in SVG units per millimetre."""
    length_mm, x = compute_round_step(CHANGE_FIGURE_HEIGHT / SCALE_BAR_SHARE / scale), CHANGE_FIGURE_WIDTH + 5
    line = f'<path class="bar" d="M{x} {CHANGE_FIGURE_HEIGHT}v{-length_mm * scale:.1f}"/>'
    return f'{line}<text transform="translate({x + 10} {CHANGE_FIGURE_HEIGHT}) rotate(-90)">{length_mm:g} mm</text>'


def _draw_frame_numbers(left: float, right: float, first: int, last: int) -> str:
    """Return the file's frame numbers at both ends of the change, as one range if they would overlap."""
    width = DIGIT_WIDTH * len(f"{last}")
    ends = ((left, f"{first}"), (right, f"{last}"))
    if right - left <= width:
        ends = (((left + right) / 2, format_frame_range(first, last)),)
    texts = ((np.clip(x, width / 2, CHANGE_FIGURE_WIDTH - width / 2), text) for x, text in ends)
    y = CHANGE_FIGURE_HEIGHT + BOTTOM_MARGIN
    return "".join(f'<text x="{x:.1f}" y="{y}" text-anchor="middle">{text}</text>' for x, text in texts)

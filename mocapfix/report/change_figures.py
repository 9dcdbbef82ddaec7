"""SVG figure of a change: one strip per axis on a common scale, input in red, result in green."""

from html import escape

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from mocapfix.report.change_curves import ChangeCurves, MarkerCurve
from mocapfix.report.terms import format_frame_range
from mocapfix.report.timeline import compute_round_step
from mocapfix.stats.sequences import find_runs

# Sizes in units of the SVG.
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

"""The picture of a change as SVG: paths on one scale, one above the other; how it was in red, how it is in green."""

from html import escape

import numpy as np

from mocapfix.report.change_curves import ChangeCurves, MarkerCurve
from mocapfix.report.html_elements import format_frame_range
from mocapfix.report.timeline import compute_round_step
from mocapfix.take import find_runs

CHANGE_FIGURE_WIDTH, CHANGE_FIGURE_HEIGHT = 300, 180  # of the paths, in the picture's own units
LEFT_MARGIN, RIGHT_MARGIN, BOTTOM_MARGIN = 40, 20, 14  # beside them, for what they are, how large, and frame numbers
AXIS_SPACING = 8  # between two strips
MAX_AXIS_NAME_LENGTH = 7  # letters of a strip's name, for which there is room
MIN_AXIS_RANGE_MM = 10.0  # millimetres: a strip is at least so high, that stillness looks still


def draw_change_figure(curves: ChangeCurves, first: int, last: int, first_frame: int) -> str:
    """-> SVG of a change over the frames first..last; `start` is the file's own number of frame 0."""
    low, high = _compute_axis_ranges(curves)
    scale = (CHANGE_FIGURE_HEIGHT - AXIS_SPACING * (len(low) - 1)) / (high - low).sum()
    tops = np.concatenate([[0], np.cumsum((high - low) * scale + AXIS_SPACING)[:-1]])
    span = max(1, curves.frames[-1] - curves.frames[0])

    def place(values: np.ndarray) -> np.ndarray:
        """(N, S) millimetres -> (N, S) down the picture."""
        return tops + (high - values) * scale

    x = CHANGE_FIGURE_WIDTH * (curves.frames - curves.frames[0]) / span
    last = min(last, int(curves.frames[-1]))
    a, b = (CHANGE_FIGURE_WIDTH * (t - curves.frames[0]) / span for t in (first, last))
    content = f'<rect class="when" x="{a - 1:.1f}" y="-4" width="{b - a + 2:.1f}" height="{CHANGE_FIGURE_HEIGHT + 8}"/>'
    content += _draw_band(x, place(curves.band_mm[..., 0]), place(curves.band_mm[..., 1]))
    order = sorted(curves.curves, key=lambda curve: ("was", "kept", "now").index(curve.kind))
    content += "".join(_draw_curve(curve, x, place(curve.values_mm)) for curve in order)
    content += "".join(
        f'<text x="-6" y="{top + (h - w) * scale / 2 + 3:.1f}" text-anchor="end">{escape(name[:MAX_AXIS_NAME_LENGTH])}</text>'
        for name, top, w, h in zip(curves.axis_names, tops, low, high, strict=True)
    )
    content += _draw_scale_bar(scale) + _draw_frame_numbers(a, b, first_frame + first, first_frame + last)
    box = f"{-LEFT_MARGIN} -6 {LEFT_MARGIN + CHANGE_FIGURE_WIDTH + RIGHT_MARGIN} {CHANGE_FIGURE_HEIGHT + BOTTOM_MARGIN + 12}"
    return f'<svg class="change" viewBox="{box}" role="img" aria-label="before and after">{content}</svg>'


def _compute_axis_ranges(curves: ChangeCurves) -> tuple[np.ndarray, np.ndarray]:
    """-> the least and the greatest value of each strip, millimetres."""
    values = np.concatenate([*(curve.values_mm for curve in curves.curves), curves.band_mm[..., 0], curves.band_mm[..., 1]])
    values = np.where(np.isfinite(values).any(axis=0), values, 0.0)
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    more = np.maximum(0, MIN_AXIS_RANGE_MM - (high - low)) / 2
    return low - more, high + more


def _draw_curve(curve: MarkerCurve, x: np.ndarray, y: np.ndarray) -> str:
    """x (N,) and y (N, S) -> one SVG path; a sample alone is a dot."""
    parts = (
        "M" + "L".join(f"{x[i]:.1f} {y[i, s]:.1f}" for i in range(a, b + 1)) + ("h0" if a == b else "")
        for s in range(y.shape[1])
        for a, b in find_runs(np.isfinite(y[:, s]))
    )
    lines = "".join(parts)
    return f'<path class="{curve.kind} rank{curve.rank}" d="{lines}"/>' if lines else ""


def _draw_band(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> str:
    """x (N,) and the edges (N, S) of what lies between them."""
    areas = ""
    for s in range(low.shape[1]):
        for a, b in find_runs(np.isfinite(low[:, s])):
            there = [f"{x[i]:.1f} {high[i, s]:.1f}" for i in range(a, b + 1)]
            areas += "M" + "L".join(there + [f"{x[i]:.1f} {low[i, s]:.1f}" for i in range(b, a - 1, -1)]) + "Z"
    return f'<path class="band" d="{areas}"/>' if areas else ""


def _draw_scale_bar(scale: float) -> str:
    """A length beside the paths that is a round number of millimetres."""
    length, x = compute_round_step(CHANGE_FIGURE_HEIGHT / 6 / scale), CHANGE_FIGURE_WIDTH + 5
    line = f'<path class="bar" d="M{x} {CHANGE_FIGURE_HEIGHT}v{-length * scale:.1f}"/>'
    return f'{line}<text transform="translate({x + 10} {CHANGE_FIGURE_HEIGHT}) rotate(-90)">{length:g} mm</text>'


def _draw_frame_numbers(a: float, b: float, first: int, last: int) -> str:
    """The file's frame numbers at both ends of the change, together where they would meet."""
    wide = 7 * len(f"{last}")
    ends = ((a, f"{first}"), (b, f"{last}")) if b - a > wide else (((a + b) / 2, format_frame_range(first, last)),)
    places = ((np.clip(x, wide / 2, CHANGE_FIGURE_WIDTH - wide / 2), text) for x, text in ends)
    return "".join(
        f'<text x="{x:.1f}" y="{CHANGE_FIGURE_HEIGHT + BOTTOM_MARGIN}" text-anchor="middle">{text}</text>' for x, text in places
    )

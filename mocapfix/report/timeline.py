"""The take's time line on the page: a row of faults for each marker that has any, and the distance from the body below.

Places are shares of the take's length, so that the rows are as wide as whatever shows them.
"""

from collections import defaultdict
from collections.abc import Iterator
from html import escape
from typing import NamedTuple

import numpy as np

from mocapfix.faults import Fault
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.sample_states import SAMPLE_EMPTY, SAMPLE_SUSPECT
from mocapfix.report.terms import get_fault_group
from mocapfix.take import Take, find_runs

MAX_TIME_TICKS = 6  # at most
MAX_RESIDUAL_BINS = 500  # of the curves at most
TIMELINE_RESOLUTION = (
    300  # of the take's length: bars that are no farther apart are drawn as one, for nobody could tell them apart
)


class _TimelineBar(NamedTuple):
    """Over first..last, indices into the take; name: classes of the page's style sheet."""

    css_class: str
    first: int
    last: int
    title: str


def render_fault_rows(comparison: CleaningComparison) -> str:
    """-> HTML of the rows of bars, coloured by the group of the fault, outlined where it was left as it was.

    A trajectory of which something was taken over has a row that says so; of one that continues no marker there is none.
    """
    take, made = comparison.input_take, {id(fault) for _, fault in comparison.applied_changes}
    idle = {id(fault) for fault in comparison.unchanged_faults if fault.kind == "fragment"}
    lanes: dict[int, list[_TimelineBar]] = defaultdict(list)
    for fault in (fault for fault in comparison.faults.items if id(fault) not in idle):
        for m in (m for m in fault.markers if m < len(take.labels)):
            lanes[m] += _build_bars(fault, comparison.sample_states[fault.frame_slice, m], id(fault) in made)
    for donor, fragments in comparison.fragments_by_donor.items():
        for each in fragments:
            lanes[donor].append(_TimelineBar("label", each.first, each.last, f"Taken over by {take.get_label(each.marker)}."))
    lines = [
        _render_row(take.get_label(m), "".join(_render_bar(bar, take) for bar in _merge_near_bars(lanes[m], take)))
        for m in sorted(lanes)
    ]
    return "".join(lines) + render_time_axis(take) if lines else ""


def _render_row(label: str, content: str) -> str:
    return f'<div class="row"><b>{escape(label)}</b><span class="lane">{content}</span></div>'


def _build_bars(fault: Fault, sample_states: np.ndarray, is_applied: bool) -> Iterator[_TimelineBar]:
    """One bar for each stretch of the fault that was mended, or was left; state (N,) of its samples."""
    name = get_fault_group(fault.kind)
    of_samples = name in ("missing", "faulty")
    left = (
        np.isin(sample_states, (SAMPLE_EMPTY, SAMPLE_SUSPECT))
        if is_applied and of_samples
        else np.full(len(sample_states), not is_applied)
    )
    for kind, mask in ((name, ~left), (f"{name} left", left)):
        for a, b in find_runs(mask):
            yield _TimelineBar(kind, fault.first + a, fault.first + b, fault.reason)


def _merge_near_bars(bars: list[_TimelineBar], take: Take) -> Iterator[_TimelineBar]:
    """-> the bars of each kind, those that nearly touch as one; the kind of the longest comes first, below the others."""
    kinds: dict[str, list[_TimelineBar]] = defaultdict(list)
    for bar in sorted(bars, key=lambda bar: bar.first):
        kinds[bar.css_class].append(bar)
    for name, each in sorted(kinds.items(), key=lambda kind: -max(bar.last - bar.first for bar in kind[1])):
        starts = [
            n for n, bar in enumerate(each) if n == 0 or bar.first - each[n - 1].last - 1 > take.frame_count / TIMELINE_RESOLUTION
        ]
        for a, b in zip(starts, [*starts[1:], len(each)], strict=True):
            more = f" And {b - a - 1} more thereabouts." if b - a > 1 else ""
            yield _TimelineBar(name, each[a].first, max(bar.last for bar in each[a:b]), each[a].title + more)


def _render_bar(bar: _TimelineBar, take: Take) -> str:
    place = f"left:{bar.first / take.frame_count:.3%};width:{(bar.last - bar.first + 1) / take.frame_count:.3%}"
    return f'<i class="{bar.css_class}" style="{place}" title="{escape(bar.title)}"></i>'


def render_time_axis(take: Take) -> str:
    """-> HTML of the ticks: the file's frame numbers, and seconds from its first frame."""
    seconds = take.frame_count / take.rate
    times = np.arange(0, seconds, compute_round_step(seconds / MAX_TIME_TICKS))
    ticks = "".join(
        f'<i style="left:{time / seconds:.3%}">{take.get_frame_number(round(time * take.rate))}<small>{time:g} s</small></i>'
        for time in times
    )
    return f'<div class="row axis"><b>frame</b><span class="lane">{ticks}</span></div>'


def compute_round_step(minimum: float) -> float:
    """-> the next of ... 0.1, 0.2, 0.5, 1, 2, 5 ..."""
    power = 10.0 ** np.floor(np.log10(minimum))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10) if step * power >= minimum * (1 - 1e-9))


def render_residual_curves(residual_m: np.ndarray) -> str:
    """error (T, M) metres, NaN where unknown -> HTML of its median and 95th percentile over the markers, in millimetres."""
    bins = [part[np.isfinite(part)] * 1e3 for part in np.array_split(residual_m, min(MAX_RESIDUAL_BINS, len(residual_m)))]
    middle = np.array([np.median(part) if part.size else np.nan for part in bins])
    high = np.array([np.percentile(part, 95) if part.size else np.nan for part in bins])
    if np.isnan(middle).all():
        return ""
    top = compute_round_step(np.nanmax(high) or 1.0)
    paths = "".join(
        f'<path class="{name}" d="{_draw_line(values / top)}"/>' for name, values in (("high", high), ("middle", middle))
    )
    svg = f'<svg viewBox="0 0 1 1" preserveAspectRatio="none" role="img" aria-label="distance from the body">{paths}</svg>'
    return f'<div class="row curve"><b>{top:g} mm<small>0</small></b><span class="lane">{svg}</span></div>'


def _draw_line(values: np.ndarray) -> str:
    """values (N,) of 0..1 -> the line through their bins' middles, interrupted where they are NaN."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    there = find_runs(np.isfinite(values))
    return "".join("M" + "L".join(f"{x[i]:.4f} {1 - values[i]:.3f}" for i in range(a, b + 1)) for a, b in there)

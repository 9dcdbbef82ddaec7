"""Time line of a take: one row of faults per affected marker, and the distance of the markers from the body.

Positions and widths are shares of the take's length, so that they scale with the page.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.faults import Fault
from mocapfix.report.sample_states import CleaningComparison, SampleOutcome
from mocapfix.report.terms import get_fault_group
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

MAX_TIME_TICKS = 6
MAX_RESIDUAL_BINS = 500
TIMELINE_RESOLUTION = 300  # bars closer than the take's length divided by this are drawn as one


@dataclass(frozen=True)
class TimelineBar:
    """A bar over the frame indices first..last.

    css_class  group of the fault, with "left" if the samples were not changed
    title      text shown on hovering
    """

    css_class: str
    first: int
    last: int
    title: str


@dataclass(frozen=True)
class TimelineRow:
    """The bars of one marker."""

    label: str
    bars: tuple[TimelineBar, ...]


@dataclass(frozen=True)
class TimeTick:
    """A mark on the time axis: its share of the take's length, the file's frame number and the time in seconds."""

    share: float
    frame_number: int
    time_s: float


@dataclass(frozen=True)
class ResidualPlot:
    """Median and 95th percentile of the residuals over time, as SVG paths in the unit square.

    limit_mm  value at the upper edge
    """

    limit_mm: float
    median_path: str
    percentile_path: str


def build_fault_rows(comparison: CleaningComparison) -> list[TimelineRow]:
    """Return the rows of all trajectories with faults.

    The donor of a joined fragment has a row as well; a fragment that matches no marker has none.
    """
    take, applied = comparison.input_take, {id(fault) for _, fault in comparison.applied_changes}
    unused = {id(fault) for fault in comparison.unchanged_faults if fault.kind == "fragment"}
    bars: defaultdict[int, list[TimelineBar]] = defaultdict(list)
    for fault in (fault for fault in comparison.faults.items if id(fault) not in unused):
        for m in (m for m in fault.markers if m < len(take.labels)):
            bars[m] += _build_bars(fault, comparison.sample_states[fault.frame_slice, m], id(fault) in applied)
    for donor, fragments in comparison.fragments_by_donor.items():
        for each in fragments:
            bars[donor].append(TimelineBar("label", each.first, each.last, f"Joined to {take.get_label(each.marker)}."))
    return [TimelineRow(take.get_label(m), tuple(_merge_near_bars(bars[m], take.frame_count))) for m in sorted(bars)]


def _build_bars(fault: Fault, outcome: Int[np.ndarray, " N"], is_applied: bool) -> Iterator[TimelineBar]:
    """Yield one bar for each corrected or unchanged interval of a fault; `outcome` is that of its N samples."""
    group = get_fault_group(fault.kind)
    unchanged = np.full(len(outcome), not is_applied)
    if is_applied and group in ("missing", "faulty"):
        unchanged = (outcome == SampleOutcome.EMPTY) | (outcome == SampleOutcome.SUSPECT)
    for css_class, mask in ((group, ~unchanged), (f"{group} left", unchanged)):
        for first, last in find_runs(mask):
            yield TimelineBar(css_class, fault.first + first, fault.first + last, fault.reason)


def _merge_near_bars(bars: Sequence[TimelineBar], frame_count: int) -> Iterator[TimelineBar]:
    """Yield the bars with near bars of one class merged; the class of the longest bar comes first, below the others."""
    by_class: defaultdict[str, list[TimelineBar]] = defaultdict(list)
    for bar in sorted(bars, key=lambda bar: bar.first):
        by_class[bar.css_class].append(bar)
    for css_class, each in sorted(by_class.items(), key=lambda item: -max(bar.last - bar.first for bar in item[1])):
        max_gap = frame_count / TIMELINE_RESOLUTION
        starts = [n for n, bar in enumerate(each) if n == 0 or bar.first - each[n - 1].last - 1 > max_gap]
        for start, end in zip(starts, [*starts[1:], len(each)], strict=True):
            more = f" And {end - start - 1} more nearby." if end - start > 1 else ""
            last = max(bar.last for bar in each[start:end])
            yield TimelineBar(css_class, each[start].first, last, each[start].title + more)


def build_time_ticks(take: Take) -> list[TimeTick]:
    """Return the marks of the time axis; times start at the first frame."""
    duration_s = take.frame_count / take.rate
    times = np.arange(0, duration_s, compute_round_step(duration_s / MAX_TIME_TICKS))
    return [TimeTick(time / duration_s, take.get_frame_number(round(time * take.rate)), time) for time in times]


def compute_round_step(minimum: float) -> float:
    """Return the smallest number 1, 2 or 5 times a power of ten that is at least `minimum`."""
    power = 10.0 ** np.floor(np.log10(minimum))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10) if step * power >= minimum * (1 - 1e-9))


def build_residual_plot(residual_m: Float[np.ndarray, "T M"]) -> ResidualPlot | None:
    """Return the median and the 95th percentile of the residuals over the markers; None if all are NaN."""
    bins = [part[np.isfinite(part)] * 1e3 for part in np.array_split(residual_m, min(MAX_RESIDUAL_BINS, len(residual_m)))]
    median_mm = np.array([np.median(part) if part.size else np.nan for part in bins])
    percentile_mm = np.array([np.percentile(part, 95) if part.size else np.nan for part in bins])
    if np.isnan(median_mm).all():
        return None
    limit_mm = compute_round_step(np.nanmax(percentile_mm) or 1.0)
    return ResidualPlot(limit_mm, _draw_line(median_mm / limit_mm), _draw_line(percentile_mm / limit_mm))


def _draw_line(values: Float[np.ndarray, " N"]) -> str:
    """Return the SVG path of values between 0 and 1 at the centres of their bins, interrupted at NaN."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    intervals = find_runs(np.isfinite(values))
    return "".join("M" + "L".join(f"{x[i]:.4f} {1 - values[i]:.3f}" for i in range(a, b + 1)) for a, b in intervals)

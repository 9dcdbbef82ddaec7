"""The take's time line on the page: a row of faults for each marker that has any, and the distance from the body below.

Places are shares of the take's length, so that the rows are as wide as whatever shows them.
"""

from html import escape

import numpy as np

from mocapfix.faults import MISSING, Fault, Faults
from mocapfix.show.states import DOUBTED, EMPTY
from mocapfix.take import Take, runs

TICKS = 6  # at most
BINS = 500  # of the curves at most


def rows(take: Take, faults: Faults, state: np.ndarray) -> str:
    """-> HTML of the rows of bars, coloured by the kind of fault, outlined where it was left; state (T, M) as in states."""
    if not faults.items:
        return ""
    of_marker: dict[int, list[Fault]] = {}
    for fault in faults.items:
        of_marker.setdefault(fault.marker, []).append(fault)
    lines = [_line(take.labels[m], "".join(_bars(take, fault, state[:, m]) for fault in of_marker[m])) for m in sorted(of_marker)]
    return "".join(lines) + axis(take)


def _line(label: str, content: str) -> str:
    return f'<div class="row"><b>{escape(label)}</b><span class="lane">{content}</span></div>'


def _bars(take: Take, fault: Fault, state: np.ndarray) -> str:
    """One bar for each stretch of the fault that was mended, or was left."""
    left = np.isin(state[fault.first : fault.last + 1], (EMPTY, DOUBTED))
    kind = "gap" if fault.kind in MISSING else fault.kind
    return "".join(
        f'<i class="{kind}{name}" style="left:{(fault.first + a) / take.frames:.3%};width:{(b - a + 1) / take.frames:.3%}"'
        f' title="{escape(fault.reason)}"></i>'
        for name, mask in (("", ~left), (" left", left))
        for a, b in runs(mask)
    )


def axis(take: Take) -> str:
    """-> HTML of the ticks: the file's frame numbers, and seconds from its first frame."""
    seconds = take.frames / take.rate
    step = _step(seconds / TICKS)
    times = np.arange(0, seconds, step)
    ticks = "".join(
        f'<i style="left:{time / seconds:.3%}">{take.frame_number(round(time * take.rate))}<small>{time:g} s</small></i>'
        for time in times
    )
    return f'<div class="row axis"><b>frame</b><span class="lane">{ticks}</span></div>'


def _step(least: float) -> float:
    """-> the next of ... 0.1, 0.2, 0.5, 1, 2, 5 ... seconds."""
    power = 10.0 ** np.floor(np.log10(least))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10) if step * power >= least * (1 - 1e-9))


def curves(error: np.ndarray) -> str:
    """error (T, M) metres, NaN where unknown -> HTML of its median and 95th percentile over the markers, in millimetres."""
    bins = [part[np.isfinite(part)] * 1e3 for part in np.array_split(error, min(BINS, len(error)))]
    middle = np.array([np.median(part) if part.size else np.nan for part in bins])
    high = np.array([np.percentile(part, 95) if part.size else np.nan for part in bins])
    if np.isnan(middle).all():
        return ""
    top = _step(np.nanmax(high) or 1.0)
    paths = "".join(f'<path class="{name}" d="{_path(values / top)}"/>' for name, values in (("high", high), ("middle", middle)))
    svg = f'<svg viewBox="0 0 1 1" preserveAspectRatio="none" role="img" aria-label="distance from the body">{paths}</svg>'
    return f'<div class="row curve"><b>{top:g} mm<small>0</small></b><span class="lane">{svg}</span></div>'


def _path(values: np.ndarray) -> str:
    """values (N,) of 0..1 -> the line through their bins' middles, interrupted where they are NaN."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    there = runs(np.isfinite(values))
    return "".join("M" + "L".join(f"{x[i]:.4f} {1 - values[i]:.3f}" for i in range(a, b + 1)) for a, b in there)

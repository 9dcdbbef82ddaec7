"""A joint that trembles for a while, each frame by itself.

Differences of the fourth order hold nearly nothing of what bodies do, and eight times the tremble. Where they are large, the
second ones say whether the joint trembles or only moves fast: of a tremble both tell the same size, of motion the second a far
greater.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.take import runs

WINDOW, SHORTEST = 0.2, 0.15  # seconds: over which the size is measured, and that a tremble lasts
FEWEST, WIDEST = 5, 7  # frames: of a tremble, and at least of the window, for a kink as of a foot that lands shows in three
SMALLEST, SWAY = np.radians(1.0), 14.0  # radians, and rad/s^2: of a tremble; what motion may leave, at low rates only
MEDIAN = 1.27  # times the median of the squares of three axes is their mean
RATIO, OFTEN = 4.0, 3.0  # times the joint's own tremble over the take, by its median; by what it does a fifth of the time
WHITE = 0.35  # of the size that second differences tell, squared
FAINT = 0.15  # of the smallest size that counts, squared: where a tremble has begun or not yet ended
POWER = {2: 6.0, 4: 70.0}  # the squares of the binomial coefficients, summed


class Tremble(NamedTuple):
    """Frames first..last, inclusive, that tremble by so many radians about each axis."""

    first: int
    last: int
    size: float


def found(course: np.ndarray, usable: np.ndarray, rate: float) -> list[Tremble]:
    """-> where a joint trembles: its course (T, 4), twice its quaternions without changes of sign, where `usable` (T,)."""
    if len(course) < 2 * FEWEST:
        return []
    fourth, second = (_told(course, usable, order) for order in (4, 2))
    known = ~np.isnan(fourth)
    if not known.any():
        return []
    window = max(WIDEST, round(WINDOW * rate)) | 1
    size, against = (MEDIAN * median_filter(np.nan_to_num(each), window) for each in (fourth, second))
    own, often = np.sqrt(MEDIAN * np.median(fourth[known])), np.sqrt(np.quantile(size[known], 0.8))
    limit = max(SMALLEST + SWAY / rate**2, RATIO * own, OFTEN * often) ** 2
    trembles = (size > limit) & (size > WHITE * against)
    kept = []
    about = binary_closing(np.nan_to_num(fourth) > max(FAINT * limit, RATIO * own**2), np.ones(4))
    for a, b in runs(trembles | about):
        if trembles[a : b + 1].any():
            first, last = a + 1, b - 1  # the outermost differences reach a frame beyond
            enough = last - first + 1 >= max(FEWEST, round(SHORTEST * rate))
            if enough and np.nanmean(fourth[first : last + 1]) > limit:
                kept.append(Tremble(int(first), int(last), float(np.sqrt(np.nanmean(fourth[first : last + 1])))))
    return _apart(kept)


def _told(course: np.ndarray, usable: np.ndarray, order: int) -> np.ndarray:
    """-> (T,) the square of the tremble per axis that differences of an order about each frame tell; NaN where they do not."""
    known = np.where(usable[:, None], course, np.nan)
    square = (np.diff(known, order, axis=0) ** 2).sum(1) / (3 * POWER[order])
    return np.pad(square, order // 2, constant_values=np.nan)


def _apart(trembles: list[Tremble]) -> list[Tremble]:
    """-> those that do not overlap, those that do being one."""
    kept: list[Tremble] = []
    for each in trembles:
        if kept and each.first <= kept[-1].last + 1:
            last = kept.pop()
            each = Tremble(last.first, max(last.last, each.last), max(last.size, each.size))
        kept.append(each)
    return kept

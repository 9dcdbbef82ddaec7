"""A joint that trembles for a while, each frame by itself.

Differences of the fourth order hold nearly nothing of what bodies do, and eight times the tremble. Where they are large, two
things tell a tremble from a joint that only moves fast. A tremble is as large by its second differences as by its fourth, motion
by the second far greater. And a tremble is about all axes, while a body that kicks, lands or claps jerks a joint about one.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.kernels.offsets import product
from mocapfix.take import runs

WINDOW, SHORTEST = 0.2, 0.15  # seconds: over which the size is measured, and that a tremble lasts
FEWEST, WIDEST = 5, 7  # frames: of a tremble, and at least of the window, for a kink as of a foot that lands shows in three
SMALLEST, SWAY = np.radians(1.0), 7.0  # radians, and rad/s^2: of a tremble; what motion may leave, at low rates only
MEDIAN = 1.27  # times the median of the squares of three axes is their mean
RATIO = 4.0  # times the joint's own tremble over the take, by its median
WHITE = 0.35, 0.7  # of the size that second differences tell, squared: of a moment, and of the whole tremble
STEADY, JERKY = 0.4, 0.15  # of the size, squared, that its median tells: about all axes, about fewer
ROUND = 0.14  # of the size about the axis of the most that there is about that of the least
ALONE = 2.0  # times what one moment in a hundred has elsewhere, a tremble not about all axes is larger
MANY, FLAT = 8, 0.33  # frames of a tremble about a single axis: less than that share of it is about the next one
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
    known = np.where(usable[:, None], course, np.nan)
    about = {order: _about_axes(known, order) for order in POWER}
    fourth, second = ((about[order] ** 2).sum(1) / (3 * POWER[order]) for order in (4, 2))
    told = ~np.isnan(fourth)
    if not told.any():
        return []
    window = max(WIDEST, round(WINDOW * rate)) | 1
    size, against = (MEDIAN * median_filter(np.nan_to_num(each), window) for each in (fourth, second))
    own = np.sqrt(MEDIAN * np.median(fourth[told]))
    limit = max(SMALLEST + SWAY / rate**2, RATIO * own) ** 2
    trembles = (size > limit) & (size > WHITE[0] * against)
    kept = []
    faintly = binary_closing(np.nan_to_num(fourth) > max(FAINT * limit, RATIO * own**2), np.ones(4))
    for a, b in runs(trembles | faintly):
        if trembles[a : b + 1].any():
            first, last = a + 1, b - 1  # the outermost differences reach a frame beyond
            if last - first + 1 >= max(FEWEST, round(SHORTEST * rate)):
                each = Tremble(int(first), int(last), float(np.sqrt(np.nanmean(fourth[first : last + 1]))))
                if each.size**2 > limit and _is_one(about, each):
                    kept.append(each)
    return _apart(kept)


def _about_axes(course: np.ndarray, order: int) -> np.ndarray:
    """-> (T, 3) the differences of an order about each frame, radians in the joint's own axes; NaN where they are not known."""
    beside = order // 2
    turned = product(course[beside:-beside] / 2 * [-1, -1, -1, 1], np.diff(course, order, axis=0))
    return np.pad(turned[:, :3], ((beside, beside), (0, 0)), constant_values=np.nan)


def _is_one(about: dict[int, np.ndarray], tremble: Tremble) -> bool:
    """-> bool: is it white, steady, and about all axes or like nothing else that the joint does? about: differences (T, 3) by
    their order."""
    spread = {}
    for order, reach in ((4, 0), (2, 1)):
        rows = about[order][max(0, tremble.first - reach) : tremble.last + 1 + reach]
        rows = rows[~np.isnan(rows[:, 0])]
        spread[order] = rows.T @ rows / max(len(rows), 1) / POWER[order]
    size = np.trace(spread[4])
    inside = _squares(about[4][tremble.first : tremble.last + 1])
    axes = np.linalg.eigvalsh(spread[4])
    all_round = axes[0] > ROUND**2 * axes[2]
    if size < WHITE[1] * np.trace(spread[2]) or MEDIAN * np.median(inside) < (STEADY if all_round else JERKY) * size:
        return False
    if all_round:
        return True
    elsewhere = _squares(np.delete(about[4], slice(max(0, tremble.first - 4), tremble.last + 5), axis=0))
    enough = len(inside) >= MANY or axes[1] > FLAT**2 * axes[2]
    return enough and len(elsewhere) > 0 and bool(size > ALONE**2 * np.quantile(elsewhere, 0.99))


def _squares(fourth: np.ndarray) -> np.ndarray:
    """-> (n,) the squares of the tremble that fourth differences (T, 3) tell, where they are known."""
    return (fourth[~np.isnan(fourth[:, 0])] ** 2).sum(1) / POWER[4]


def _apart(trembles: list[Tremble]) -> list[Tremble]:
    """-> those that do not overlap, those that do being one."""
    kept: list[Tremble] = []
    for each in trembles:
        if kept and each.first <= kept[-1].last + 1:
            last = kept.pop()
            each = Tremble(last.first, max(last.last, each.last), max(last.size, each.size))
        kept.append(each)
    return kept

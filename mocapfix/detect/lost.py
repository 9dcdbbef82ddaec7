"""Joints that are lost for a while: no numbers, zeros, or the last ones again and again.

A body at rest does not repeat itself to the last digit, and what was held while it should have moved is somewhere else when it
goes on: a held stretch is a fault where it ends in a leap. A figure that stands still on purpose, as animated ones do, leaps
nowhere, and a knee that is held straight by its limit gets there and away at its own speed. Into zeros, a joint leaps, and out
of them. Zeros of the whole figure at either end of a file are its rest pose.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mocapfix.take import runs

ABSENT, ZERO, HELD = "has no numbers", "is at zero", "is held at one value"
SHORTEST = 0.1  # seconds of one value; of several joints together one frame is enough
EXACT = 1e-9  # radians or metres: what a value spelled once more may differ by
LEAP = np.radians(1.0)  # or 17 mm: a smaller one does not show
QUICKER = 2.0  # than before it or after it, a leap is
BESIDE = 3  # frames over which that is seen
OFTEN = 0.5  # share of the frames in which a joint is held that rests
MANY = 0.8  # share of the courses: with more of them at once, it is the whole figure


class Lost(NamedTuple):
    """Courses that are lost over first..last, inclusive, and the file's way of saying so."""

    courses: tuple[int, ...]
    first: int
    last: int
    how: str


def found(steps: np.ndarray, rest: np.ndarray, absent: np.ndarray, rate: float) -> list[Lost]:
    """-> what is lost of N courses, by first frame.

    steps   (T - 1, N) how far each goes from frame to frame, radians or metres, NaN where not known
    rest    (T, N) how far each is from its rest, likewise;  absent  (T, N) where there is no number
    """
    held, zero = np.vstack([np.zeros((1, steps.shape[1]), bool), steps < EXACT]), rest < EXACT
    moving = held.mean(0) < OFTEN  # the others hardly ever do, so that it tells nothing where they do not
    held, zero = held & moving, zero & moving  # (a joint that rests for a while is at its limit, and not held)
    shortest = max(2, round(SHORTEST * rate))
    found = [Lost(courses, a, b, ABSENT) for (a, b), courses in _together(absent, np.ones_like(moving))]
    for (a, b), courses in _together(zero, moving):
        inner = a > 0 and b < len(rest) - 1
        if inner and (_leaps(steps[a - 1 :: -1], courses) & _leaps(steps[b:], courses)).any():
            found.append(Lost(courses, a, b, ZERO))
    for (a, b), courses in _together(held & ~zero & ~_over(found, zero.shape), moving):
        enough = b - a + 1 >= shortest or len(courses) > 1  # no two joints come to rest to the last digit in one frame
        if enough and b < len(rest) - 1 and _leaps(steps[b:], courses).any():
            found.append(Lost(courses, a, b, HELD))
    return sorted(found, key=lambda each: each.first)


def _leaps(steps: np.ndarray, courses: tuple[int, ...]) -> np.ndarray:
    """-> (n,) bool: do courses leap in the first of some `steps`, more than they move in those that come next?"""
    usual = np.nanmax(steps[1 : 1 + BESIDE][:, courses], axis=0, initial=0.0)
    return steps[0, courses] > LEAP + QUICKER * usual


def _together(mask: np.ndarray, moving: np.ndarray) -> Iterator[tuple[tuple[int, int], tuple[int, ...]]]:
    """Yield (first, last), and the courses (T, N) that are so from then till then; all of them where nearly all are that are
    `moving` (N,)."""
    count = mask.shape[1]
    whole = mask.sum(1) >= max(MANY * moving.sum(), 1)
    together: dict[tuple[int, int], list[int]] = {(int(a), int(b)): list(range(count)) for a, b in runs(whole)}
    for n in range(count):
        for a, b in runs(mask[:, n]):
            if not whole[a : b + 1].any():
                together.setdefault((int(a), int(b)), []).append(n)
    yield from ((span, tuple(courses)) for span, courses in sorted(together.items()))


def _over(found: list[Lost], shape: tuple[int, int]) -> np.ndarray:
    """-> (T, N) bool: what is lost, and the frame after it."""
    mask = np.zeros(shape, bool)
    for each in found:
        mask[each.first : each.last + 2, list(each.courses)] = True
    return mask

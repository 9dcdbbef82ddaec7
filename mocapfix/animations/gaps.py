"""Joints that are lost for a while: no numbers, zeros, or the last ones again and again.

A body at rest does not repeat itself to the last digit, and what was held while it should have moved is somewhere else when it
goes on: a held stretch is a fault where it ends in a leap. A figure that stands still on purpose, as animated ones do, leaps
nowhere, and a knee that is held straight by its limit gets there and away at its own speed. Into zeros, a joint leaps, and out
of them. Zeros of the whole figure at either end of a file are its rest pose.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mocapfix.stats.runs import find_runs

NO_VALUES, ALL_ZERO, VALUE_HELD = "has no numbers", "is at zero", "is held at one value"
MIN_HELD_DURATION_S = 0.1  # seconds of one value; of several joints together one frame is enough
MAX_REPEATED_DIFFERENCE = 1e-9  # radians or metres: what a value spelled once more may differ by
MIN_JUMP_RAD = np.radians(1.0)  # or 17 mm: a smaller one does not show
MIN_JUMP_RATIO = 2.0  # than before it or after it, a leap is
JUMP_CONTEXT_FRAMES = 3  # frames over which that is seen
MAX_HELD_SHARE = 0.5  # share of the frames in which a joint is held that rests
WHOLE_FIGURE_SHARE = 0.8  # share of the courses: with more of them at once, it is the whole figure


class AnimationGap(NamedTuple):
    """Courses that are lost over first..last, inclusive, and the file's way of saying so."""

    tracks: tuple[int, ...]
    first: int
    last: int
    appearance: str


def detect_animation_gaps(
    steps: np.ndarray, rest_distances: np.ndarray, is_absent: np.ndarray, rate: float
) -> list[AnimationGap]:
    """-> what is lost of N courses, by first frame.

    steps   (T - 1, N) how far each goes from frame to frame, radians or metres, NaN where not known
    rest    (T, N) how far each is from its rest, likewise;  absent  (T, N) where there is no number
    """
    held, zero = (
        np.vstack([np.zeros((1, steps.shape[1]), bool), steps < MAX_REPEATED_DIFFERENCE]),
        rest_distances < MAX_REPEATED_DIFFERENCE,
    )
    moving = held.mean(0) < MAX_HELD_SHARE  # the others hardly ever do, so that it tells nothing where they do not
    held, zero = held & moving, zero & moving  # (a joint that rests for a while is at its limit, and not held)
    shortest = max(2, round(MIN_HELD_DURATION_S * rate))
    found = [AnimationGap(courses, a, b, NO_VALUES) for (a, b), courses in _group_tracks(is_absent, np.ones_like(moving))]
    for (a, b), courses in _group_tracks(zero, moving):
        inner = a > 0 and b < len(rest_distances) - 1
        if inner and (_detect_jumps(steps[a - 1 :: -1], courses) & _detect_jumps(steps[b:], courses)).any():
            found.append(AnimationGap(courses, a, b, ALL_ZERO))
    for (a, b), courses in _group_tracks(held & ~zero & ~_build_gap_mask(found, zero.shape), moving):
        enough = b - a + 1 >= shortest or len(courses) > 1  # no two joints come to rest to the last digit in one frame
        if enough and b < len(rest_distances) - 1 and _detect_jumps(steps[b:], courses).any():
            found.append(AnimationGap(courses, a, b, VALUE_HELD))
    return sorted(found, key=lambda each: each.first)


def _detect_jumps(steps: np.ndarray, tracks: tuple[int, ...]) -> np.ndarray:
    """-> (n,) bool: do courses leap in the first of some `steps`, more than they move in those that come next?"""
    usual = np.nanmax(steps[1 : 1 + JUMP_CONTEXT_FRAMES][:, tracks], axis=0, initial=0.0)
    return steps[0, tracks] > MIN_JUMP_RAD + MIN_JUMP_RATIO * usual


def _group_tracks(mask: np.ndarray, is_moving: np.ndarray) -> Iterator[tuple[tuple[int, int], tuple[int, ...]]]:
    """Yield (first, last), and the courses (T, N) that are so from then till then; all of them where nearly all are that are
    `moving` (N,)."""
    count = mask.shape[1]
    whole = mask.sum(1) >= max(WHOLE_FIGURE_SHARE * is_moving.sum(), 1)
    together: dict[tuple[int, int], list[int]] = {(int(a), int(b)): list(range(count)) for a, b in find_runs(whole)}
    for n in range(count):
        for a, b in find_runs(mask[:, n]):
            if not whole[a : b + 1].any():
                together.setdefault((int(a), int(b)), []).append(n)
    yield from ((span, tuple(courses)) for span, courses in sorted(together.items()))


def _build_gap_mask(gaps: list[AnimationGap], shape: tuple[int, int]) -> np.ndarray:
    """-> (T, N) bool: what is lost, and the frame after it."""
    mask = np.zeros(shape, bool)
    for each in gaps:
        mask[each.first : each.last + 2, list(each.tracks)] = True
    return mask

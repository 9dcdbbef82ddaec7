"""Detection of gaps in an animation: intervals without values, of zeros, or of one repeated value.

A moving body does not repeat a value to the last digit, and after a gap in which the last value was held it is somewhere else:
an interval of one value is a gap if it ends in a jump. A figure that stands still on purpose, as in keyframe animation, does not
jump, and a knee at its joint limit arrives and leaves at its own speed. Zeros are a gap if the joint jumps to them and back.
Zeros of the whole figure at the start or end of a file are its rest pose.
"""

from collections.abc import Iterator
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.sequences import find_runs

MIN_HELD_DURATION_S = 0.1  # of one value in one track; if several tracks are held together, one frame is enough
MIN_HELD_FRAMES = 2
MAX_REPEATED_DIFFERENCE = 1e-9  # radians or metres between two frames that hold the same value
MIN_JUMP = np.radians(1.0)  # radians, or metres: a smaller jump is not visible
MIN_JUMP_RATIO = 2.0  # of a jump to the largest step in the frames next to it
JUMP_CONTEXT_FRAMES = 3  # frames that a jump is compared with
MAX_HELD_SHARE = 0.5  # a track that is held in a larger share of all frames is at rest, so holding is not a fault
WHOLE_FIGURE_SHARE = 0.8  # of the moving tracks: if more are lost at once, the whole figure is


class GapAppearance(StrEnum):
    """What a file holds in a gap."""

    ABSENT = "no values"
    ZERO = "all values are zero"
    HELD = "held at one value"


class AnimationGap(NamedTuple):
    """Tracks that are lost in the frames first..last, inclusive."""

    tracks: tuple[int, ...]
    first: int
    last: int
    appearance: GapAppearance


class TrackMotion(NamedTuple):
    """Motion of N tracks over T frames, NaN where unknown.

    steps  (T - 1, N) distance from each frame to the next, radians or metres
    rest_distances  (T, N) distance from the rest pose, likewise
    """

    steps: Float[np.ndarray, "S N"]
    rest_distances: Float[np.ndarray, "T N"]


def detect_animation_gaps(motion: TrackMotion, is_absent: Bool[np.ndarray, "T N"], rate: float) -> list[AnimationGap]:
    """Detect the gaps of N tracks, ordered by first frame. `is_absent` marks frames without a value."""
    steps, last_frame = motion.steps, len(motion.rest_distances) - 1
    is_held = np.vstack([np.zeros((1, steps.shape[1]), bool), steps < MAX_REPEATED_DIFFERENCE])
    is_zero = motion.rest_distances < MAX_REPEATED_DIFFERENCE
    is_moving = is_held.mean(0) < MAX_HELD_SHARE
    is_held, is_zero = is_held & is_moving, is_zero & is_moving
    min_held_frames = max(MIN_HELD_FRAMES, round(MIN_HELD_DURATION_S * rate))
    gaps = [
        AnimationGap(tracks, first, last, GapAppearance.ABSENT)
        for (first, last), tracks in _group_tracks(is_absent, np.ones_like(is_moving))
    ]
    for (first, last), tracks in _group_tracks(is_zero, is_moving):
        is_inside = first > 0 and last < last_frame
        if is_inside and (_detect_jumps(steps[first - 1 :: -1], tracks) & _detect_jumps(steps[last:], tracks)).any():
            gaps.append(AnimationGap(tracks, first, last, GapAppearance.ZERO))
    for (first, last), tracks in _group_tracks(is_held & ~is_zero & ~_build_gap_mask(gaps, is_zero.shape), is_moving):
        # Two moving joints do not stop in the same frame, to the last digit.
        is_long_enough = last - first + 1 >= min_held_frames or len(tracks) > 1
        if is_long_enough and last < last_frame and _detect_jumps(steps[last:], tracks).any():
            gaps.append(AnimationGap(tracks, first, last, GapAppearance.HELD))
    return sorted(gaps, key=lambda gap: gap.first)


def _detect_jumps(steps: Float[np.ndarray, "S N"], tracks: tuple[int, ...]) -> Bool[np.ndarray, " n"]:
    """Return, for each of the tracks, whether the first step is a jump compared with the steps that follow."""
    context = np.nanmax(steps[1 : 1 + JUMP_CONTEXT_FRAMES][:, tracks], axis=0, initial=0.0)
    return steps[0, tracks] > MIN_JUMP + MIN_JUMP_RATIO * context


def _group_tracks(
    mask: Bool[np.ndarray, "T N"], is_moving: Bool[np.ndarray, " N"]
) -> Iterator[tuple[tuple[int, int], tuple[int, ...]]]:
    """Yield the (first, last) frames of each run of True, and the tracks that have it.

    Where nearly as many tracks as are moving are True, the run is of all tracks.
    """
    track_count = mask.shape[1]
    is_whole_figure = mask.sum(1) >= max(WHOLE_FIGURE_SHARE * is_moving.sum(), 1)
    tracks_by_run: dict[tuple[int, int], list[int]] = {run: list(range(track_count)) for run in find_runs(is_whole_figure)}
    for track in range(track_count):
        for first, last in find_runs(mask[:, track]):
            if not is_whole_figure[first : last + 1].any():
                tracks_by_run.setdefault((first, last), []).append(track)
    yield from ((run, tuple(tracks)) for run, tracks in sorted(tracks_by_run.items()))


def _build_gap_mask(gaps: list[AnimationGap], shape: tuple[int, ...]) -> Bool[np.ndarray, "T N"]:
    """Return a mask (T, N) of the gaps and of the frame after each."""
    mask = np.zeros(shape, bool)
    for gap in gaps:
        mask[gap.first : gap.last + 2, list(gap.tracks)] = True
    return mask

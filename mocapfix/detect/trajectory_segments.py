"""Pieces: what one point drew without a break, of trajectories that may belong under another label.

These are the unlabelled trajectories, and those whose label is another's with a number added (`RBAC-1` beside RBAC) or the very
same. Cameras lose a point and pick up another under the same label, so a trajectory is cut wherever it pauses or leaps.
"""

import re
from dataclasses import dataclass

import numpy as np

from mocapfix.take import Take

NUMBERED_LABEL = re.compile(r"(.*[^\W_])(?:[-_.#* ]+\d+|\s*\(\d+\))")
MAX_PAUSE_S = 0.025  # seconds: a longer one ends a piece
SEGMENT_STEP_TOLERANCE_M, SEGMENT_STEP_TOLERANCE_M_PER_S2 = (
    0.015,
    200.0,
)  # metres, m/s2: a step farther off a straight course than that in its time is another point's


@dataclass(frozen=True)
class TrajectorySegment:
    """What one point drew without a break.

    donor     index into the take's labels or, from their number on, into those of its unlabelled trajectories
    namesake  the marker whose name it bears, -1 for none
    frames    (N,) indices into the take
    points    (N, 3) metres
    """

    donor: int
    namesake: int
    frames: np.ndarray
    points: np.ndarray


def find_loose_segments(take: Take) -> list[TrajectorySegment]:
    """-> the pieces of all trajectories that may belong under another label, by donor and first frame."""
    named = find_namesakes(take)
    loose = [(donor, marker, take.markers[:, donor]) for donor, marker in named.items()]
    if take.unlabelled is not None:
        loose += [(len(take.labels) + u, -1, take.unlabelled.markers[:, u]) for u in range(len(take.unlabelled.labels))]
    return [
        TrajectorySegment(donor, marker, frames, path[frames])
        for donor, marker, path in loose
        for frames in split_trajectory(np.flatnonzero(~np.isnan(path[:, 0])), path, take.rate)
    ]


def find_namesakes(take: Take) -> dict[int, int]:
    """-> the markers that bear another marker's name: their index and the other's.

    Of several with the very same label the one seen longest is the marker. A numbered label whose marker is not in the take
    is a name like any other.
    """
    seen, first = take.visible.sum(0), dict[str, int]()
    for m in np.argsort(-seen, kind="stable"):
        first.setdefault(take.labels[m], int(m))
    bases = [take.labels[m] if first[take.labels[m]] != m else _strip_number(take.labels[m]) for m in range(len(take.labels))]
    return {m: first[base] for m, base in enumerate(bases) if base in first}


def _strip_number(label: str) -> str | None:
    numbered = NUMBERED_LABEL.fullmatch(label)
    return numbered.group(1) if numbered else None


def split_trajectory(frames: np.ndarray, path: np.ndarray, rate: float) -> list[np.ndarray]:
    """-> the `frames` (N,) at which a path (T, 3) is seen, cut where it pauses, and where it leaps seen from either side."""
    if not len(frames):
        return []
    lag, step = np.diff(frames)[:, None] / rate, np.diff(path[frames], axis=0)
    ahead, behind = np.full(len(step), np.inf), np.full(len(step), np.inf)
    ahead[1:] = np.linalg.norm(step[1:] - step[:-1] / lag[:-1] * lag[1:], axis=1)
    behind[:-1] = np.linalg.norm(step[:-1] - step[1:] / lag[1:] * lag[:-1], axis=1)
    off, lag = np.minimum(ahead, behind), lag[:, 0]
    leaps = np.isfinite(off) & (off > SEGMENT_STEP_TOLERANCE_M + SEGMENT_STEP_TOLERANCE_M_PER_S2 * lag**2)
    return np.split(frames, np.flatnonzero(leaps | (lag > MAX_PAUSE_S)) + 1)


def do_segments_overlap(one: TrajectorySegment, other: TrajectorySegment) -> bool:
    """Are the two seen at one time?"""
    return bool(one.frames[0] <= other.frames[-1] and other.frames[0] <= one.frames[-1])

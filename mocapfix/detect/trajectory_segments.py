"""Trajectory segments: unbroken parts of trajectories that may belong to another label.

These are the unlabelled trajectories, and those whose label is another label with a number appended (`RBAC-1` beside `RBAC`) or
a repetition of it. Cameras lose a point and pick up another one under the same label, so a trajectory is split at pauses
and leaps.
"""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.take import Take

# A label with a number appended: "RBAC-1", "RBAC_12", "RBAC (2)".
NUMBERED_LABEL = re.compile(r"(.*[^\W_])(?:[-_.#* ]+\d+|\s*\(\d+\))")
# A longer pause ends a segment.
MAX_PAUSE_S = 0.025
# A step that deviates more from a straight path belongs to another point: a constant, and a term in the square of its time.
SEGMENT_STEP_TOLERANCE_M = 0.015
SEGMENT_STEP_TOLERANCE_M_PER_S2 = 200.0


@dataclass(frozen=True)
class TrajectorySegment:
    """An unbroken part of one trajectory.

    Attributes:
        donor: Index into the take's labels or, from their number on, into its unlabelled trajectories.
        namesake: Index of the marker whose label it has, -1 if none.
        frames: Frame indices (N,).
        points: World positions (N, 3) in metres.
    """

    donor: int
    namesake: int
    frames: np.ndarray
    points: np.ndarray

    @property
    def first(self) -> int:
        """Index of the first frame."""
        return int(self.frames[0])

    @property
    def last(self) -> int:
        """Index of the last frame."""
        return int(self.frames[-1])


def find_loose_segments(take: Take) -> list[TrajectorySegment]:
    """Split the trajectories that may belong to another label into segments, ordered by donor and first frame."""
    loose = [(donor, marker, take.markers[:, donor]) for donor, marker in find_namesakes(take).items()]
    if take.unlabelled is not None:
        loose += [(len(take.labels) + u, -1, take.unlabelled.markers[:, u]) for u in range(len(take.unlabelled.labels))]
    return [
        TrajectorySegment(donor, marker, frames, path[frames])
        for donor, marker, path in loose
        for frames in split_trajectory(np.flatnonzero(~np.isnan(path[:, 0])), path, take.rate)
    ]


def find_namesakes(take: Take) -> dict[int, int]:
    """Find the markers that have another marker's label; return their indices and those of the other markers.

    If several markers have the same label, the one that is visible longest is the marker. A numbered label whose base label
    is not in the take is a label of its own.
    """
    visible_count = take.visible.sum(0)
    first_of_label: dict[str, int] = {}
    for m in np.argsort(-visible_count, kind="stable"):
        first_of_label.setdefault(take.labels[m], int(m))
    bases = [label if first_of_label[label] != m else _strip_number(label) for m, label in enumerate(take.labels)]
    return {m: first_of_label[base] for m, base in enumerate(bases) if base in first_of_label}


def _strip_number(label: str) -> str | None:
    numbered = NUMBERED_LABEL.fullmatch(label)
    return numbered.group(1) if numbered else None


def split_trajectory(frames: Int[np.ndarray, " N"], path: Float[np.ndarray, "T 3"], rate: float) -> list[Int[np.ndarray, " _"]]:
    """Split the frames at which a path is visible at pauses, and at steps that are leaps as seen from both sides."""
    if not len(frames):
        return []
    lag, step = np.diff(frames)[:, None] / rate, np.diff(path[frames], axis=0)
    error_before, error_after = np.full(len(step), np.inf), np.full(len(step), np.inf)
    error_before[1:] = np.linalg.norm(step[1:] - step[:-1] / lag[:-1] * lag[1:], axis=1)
    error_after[:-1] = np.linalg.norm(step[:-1] - step[1:] / lag[1:] * lag[:-1], axis=1)
    error, lag = np.minimum(error_before, error_after), lag[:, 0]
    is_leap = np.isfinite(error) & (error > SEGMENT_STEP_TOLERANCE_M + SEGMENT_STEP_TOLERANCE_M_PER_S2 * lag**2)
    return np.split(frames, np.flatnonzero(is_leap | (lag > MAX_PAUSE_S)) + 1)

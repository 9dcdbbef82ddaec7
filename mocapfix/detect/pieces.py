"""Pieces: what one point drew without a break, of trajectories that may belong under another label.

These are the unlabelled trajectories, and those whose label is another's with a number added (`RBAC-1` beside RBAC) or the very
same. Cameras lose a point and pick up another under the same label, so a trajectory is cut wherever it pauses or leaps.
"""

import re
from dataclasses import dataclass

import numpy as np

from mocapfix.take import Take

NUMBERED = re.compile(r"(.*[^\W_])(?:[-_.#* ]+\d+|\s*\(\d+\))")
PAUSE = 0.025  # seconds: a longer one ends a piece
SLACK, BEND = 0.015, 200.0  # metres, m/s2: a step farther off a straight course than that in its time is another point's


@dataclass(frozen=True)
class Piece:
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


def pieces(take: Take) -> list[Piece]:
    """-> the pieces of all trajectories that may belong under another label, by donor and first frame."""
    named = namesakes(take)
    loose = [(donor, marker, take.markers[:, donor]) for donor, marker in named.items()]
    if take.unlabelled is not None:
        loose += [(len(take.labels) + u, -1, take.unlabelled.markers[:, u]) for u in range(len(take.unlabelled.labels))]
    return [
        Piece(donor, marker, frames, path[frames])
        for donor, marker, path in loose
        for frames in unbroken(np.flatnonzero(~np.isnan(path[:, 0])), path, take.rate)
    ]


def namesakes(take: Take) -> dict[int, int]:
    """-> the markers that bear another marker's name: their index and the other's.

    Of several with the very same label the one seen longest is the marker. A numbered label whose marker is not in the take
    is a name like any other.
    """
    seen, first = take.seen.sum(0), dict[str, int]()
    for m in np.argsort(-seen, kind="stable"):
        first.setdefault(take.labels[m], int(m))
    bases = [take.labels[m] if first[take.labels[m]] != m else _base(take.labels[m]) for m in range(len(take.labels))]
    return {m: first[base] for m, base in enumerate(bases) if base in first}


def _base(label: str) -> str | None:
    numbered = NUMBERED.fullmatch(label)
    return numbered.group(1) if numbered else None


def unbroken(frames: np.ndarray, path: np.ndarray, rate: float) -> list[np.ndarray]:
    """-> the `frames` (N,) at which a path (T, 3) is seen, cut where it pauses, and where it leaps seen from either side."""
    if not len(frames):
        return []
    lag, step = np.diff(frames)[:, None] / rate, np.diff(path[frames], axis=0)
    ahead, behind = np.full(len(step), np.inf), np.full(len(step), np.inf)
    ahead[1:] = np.linalg.norm(step[1:] - step[:-1] / lag[:-1] * lag[1:], axis=1)
    behind[:-1] = np.linalg.norm(step[:-1] - step[1:] / lag[1:] * lag[:-1], axis=1)
    off, lag = np.minimum(ahead, behind), lag[:, 0]
    leaps = np.isfinite(off) & (off > SLACK + BEND * lag**2)
    return np.split(frames, np.flatnonzero(leaps | (lag > PAUSE)) + 1)


def meet(one: Piece, other: Piece) -> bool:
    """Are the two seen at one time?"""
    return bool(one.frames[0] <= other.frames[-1] and other.frames[0] <= one.frames[-1])

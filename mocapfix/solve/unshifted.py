"""A pop or a flip undone: what lies in it keeps its motion, and is turned back by the amount that lets it go on the smoothest."""

import numpy as np

from mocapfix.kernels import offsets
from mocapfix.kernels.offsets import Undoing

BESIDE = 0.3  # seconds on either side of each edge that are asked


def turns(
    turned: np.ndarray, sound: np.ndarray, first: int, last: int, order: str, rate: float
) -> tuple[np.ndarray, float]:
    """-> the quaternions (n, 4) of one joint over first..last without what is off there, and the variance of that, rad^2 per
    axis. turned (T, 4): its quaternions; sound (T,): which are to be believed; order: the joint's axes of rotation, as "ZYX"."""
    inside = continuous(turned[first : last + 1])
    beside = _beside(sound, first, last, rate)
    known = continuous(turned[beside])
    found, variance = _undone(2 * known, beside, offsets.of_turns(inside, order), first, last, rate)
    return found / np.linalg.norm(found, axis=1, keepdims=True), variance


def place(places: np.ndarray, sound: np.ndarray, first: int, last: int, rate: float) -> tuple[np.ndarray, float]:
    """-> likewise the places (n, 3) of the root, and the variance in m^2 per axis."""
    beside = _beside(sound, first, last, rate)
    return _undone(places[beside], beside, offsets.of_places(places[first : last + 1]), first, last, rate)


def continuous(turned: np.ndarray) -> np.ndarray:
    """-> (T, 4) the same turns without changes of sign from frame to frame."""
    signs = np.where((turned[1:] * turned[:-1]).sum(1) < 0, -1.0, 1.0)
    return turned * np.cumprod(np.r_[1.0, signs])[:, None]


def _beside(sound: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    frames = max(4, round(BESIDE * rate))
    beside = np.r_[max(0, first - frames) : first, last + 1 : min(len(sound), last + 1 + frames)]
    return beside[sound[beside]]


def _undone(
    known: np.ndarray, beside: np.ndarray, ways: tuple[Undoing, ...], first: int, last: int, rate: float
) -> tuple[np.ndarray, float]:
    frames, count = max(4, round(BESIDE * rate)), last - first + 1
    near = np.unique(np.r_[: min(frames, count), max(0, count - frames) : count])
    return offsets.smoothest(known, beside / rate, ways, np.arange(first, last + 1) / rate, near)

"""Jumps in solved motion: CMU's truth has joints that turn over from one frame to the next, and stay so."""

import numpy as np

JUMP = 30.0  # rad/s: no joint of these people turned so fast


def jumps(turns: np.ndarray, rate: float) -> np.ndarray:
    """-> (T - 1, ...) bool: whether rotations (T, ..., 3, 3) at `rate` Hz jump from a frame to the next."""
    cosines = (np.einsum("t...ab,t...ab->t...", turns[1:], turns[:-1]) - 1) / 2
    return np.arccos(np.clip(cosines, -1, 1)) * rate >= JUMP


def longest_between(turns: np.ndarray, rate: float) -> slice:
    """-> the longest stretch of frames in which none of the joints (T, J, 3, 3) jumps.

    Which side of a jump is right is not to be seen; the longer is the likelier.
    """
    cuts = np.concatenate([[0], np.flatnonzero(jumps(turns, rate).any(axis=1)) + 1, [len(turns)]])
    at = int(np.diff(cuts).argmax())
    return slice(int(cuts[at]), int(cuts[at + 1]))

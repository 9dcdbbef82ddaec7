"""In which order frames are solved, and from which pose each starts."""

from typing import NamedTuple

import numpy as np


class SolveOrder(NamedTuple):
    """Chains of frames, each solved one after the other, the chains side by side."""

    frames: np.ndarray  # (N,) the frames, chain after chain
    start_frame: np.ndarray  # (N,) the frame whose pose each starts from; -1 for its own
    copied_joints: np.ndarray  # (1 or T, J) bool: the joints that it takes from there; with the root its place, too
    chain_starts: np.ndarray  # (C + 1,) where each chain begins in `order`, and the end


def order_independently(frames: int, joints: int) -> SolveOrder:
    """-> every frame for itself, from its own pose."""
    return SolveOrder(np.arange(frames), np.full(frames, -1), np.zeros((1, joints), bool), np.arange(frames + 1))


def order_sequentially(has_own_pose: np.ndarray, joints: int) -> SolveOrder:
    """-> each frame that has a pose of its `own` (T,) from that, as the first has, each other from the one before it."""
    order = np.arange(len(has_own_pose))
    return SolveOrder(
        order,
        np.where(has_own_pose, -1, order - 1),
        np.ones((1, joints), bool),
        np.r_[np.flatnonzero(has_own_pose), len(has_own_pose)],
    )


def order_in_windows(frames: int, joints: int, length: int) -> SolveOrder:
    """-> each frame from the one before it, but for the first of each window of `length` frames.

    The windows, not the number of threads, are what is solved side by side, so that this changes nothing.
    """
    return order_sequentially(np.arange(frames) % length == 0, joints)


def order_from_gap_ends(runs: list[tuple[int, int]], uncertain_joints: np.ndarray) -> SolveOrder:
    """-> the `runs` (first, last) of frames from both ends to the middle, each frame from its neighbour farther out.

    Joints that are `unsure` (T, J) start where the neighbour has them, the others, and the root, where they are: where
    markers leave two poses open, as a thigh does that lost its knee, the one that goes on smoothly is found. A run at the
    take's beginning or end has one end only; in a run of all frames the take's first is the end, and is not solved anew.
    """
    order, source, chains, end = [], [], [0], len(uncertain_joints) - 1
    for left, right in runs:
        inside = np.arange(left, right + 1)
        if left == 0 and right == end:
            turns = [(int(t), int(t) - 1) for t in inside[1:]]
        elif left == 0:
            turns = [(int(t), int(t) + 1) for t in inside[::-1]]
        elif right == end:
            turns = [(int(t), int(t) - 1) for t in inside]
        else:
            half = (len(inside) + 1) // 2
            forth, back = [(int(t), int(t) - 1) for t in inside[:half]], [(int(t), int(t) + 1) for t in inside[half:][::-1]]
            turns = [turn for pair in zip(forth, [*back, None], strict=False) for turn in pair if turn is not None]
        order += [t for t, _ in turns]
        source += [s for _, s in turns]
        chains.append(len(order))
    taken = uncertain_joints.copy()
    taken[:, 0] = False
    return SolveOrder(np.array(order, int), np.array(source, int), taken, np.array(chains))

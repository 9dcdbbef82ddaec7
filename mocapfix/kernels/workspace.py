"""What the solve of a frame writes on the way, and the frame's pose in and out of it."""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.low_rank import Answers, empty_answers
from mocapfix.kernels.pose import Pose, copy, empty_pose
from mocapfix.kernels.sweep import Factors, Step, empty_factors, empty_step
from mocapfix.kernels.system import System, empty_system


class Workspace(NamedTuple):
    """All that the solve of a frame writes on the way; made once for many frames."""

    pose: Pose
    new: Pose
    system: System
    factors: Factors
    step: Step
    answers: Answers | None  # where there are rows
    g: np.ndarray  # (J, 6) spare
    b: np.ndarray  # (J, 3) spare


@njit(cache=True)
def workspace(joints, unknowns, rows):
    """-> room to solve frames of so many joints, unknowns shared by the joints, and rows (None for none).

    None spares those who have no rows the compilation of what is done with them.
    """
    return Workspace(
        empty_pose(joints, unknowns), empty_pose(joints, unknowns), empty_system(joints, unknowns, rows),
        empty_factors(joints, unknowns), empty_step(joints, unknowns), empty_answers(joints, unknowns, rows),
        np.empty((joints, 6)), np.empty((joints, 3)),
    )  # fmt: skip


@njit(cache=True)
def place(source, target):
    """Copy a pose."""
    copy(source.root, target.root)
    copy(source.local, target.local)
    copy(source.shared, target.shared)
    copy(source.position, target.position)
    copy(source.rotation, target.rotation)


@njit(cache=True)
def load(root, local, shared, t, pose):
    """Copy frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P) into `pose`."""
    copy(root[t], pose.root)
    copy(local[t], pose.local)
    copy(shared[t], pose.shared)


@njit(cache=True)
def store(pose, root, local, shared, t):
    """The reverse of `load`."""
    copy(pose.root, root[t])
    copy(pose.local, local[t])
    copy(pose.shared, shared[t])

"""What the solve of a frame writes on the way, and the frame's pose in and out of it."""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.forward_kinematics import FramePose, allocate_pose, copy_array
from mocapfix.kernels.low_rank import RowResponses, allocate_row_responses
from mocapfix.kernels.normal_equations import NormalEquations, allocate_equations
from mocapfix.kernels.sweep import PoseStep, SweepFactors, allocate_factors, allocate_step


class SolveWorkspace(NamedTuple):
    """All that the solve of a frame writes on the way; made once for many frames."""

    pose: FramePose
    trial_pose: FramePose
    system: NormalEquations
    factors: SweepFactors
    step: PoseStep
    row_responses: RowResponses | None  # where there are rows
    g: np.ndarray  # (J, 6) spare
    g_joint: np.ndarray  # (J, 3) spare


@njit(cache=True)
def allocate_workspace(joints, unknowns, rows):
    """-> room to solve frames of so many joints, unknowns shared by the joints, and rows (None for none).

    None spares those who have no rows the compilation of what is done with them.
    """
    return SolveWorkspace(
        allocate_pose(joints, unknowns), allocate_pose(joints, unknowns), allocate_equations(joints, unknowns, rows),
        allocate_factors(joints, unknowns), allocate_step(joints, unknowns), allocate_row_responses(joints, unknowns, rows),
        np.empty((joints, 6)), np.empty((joints, 3)),
    )  # fmt: skip


@njit(cache=True)
def copy_pose(source, target):
    """Copy a pose."""
    copy_array(source.root, target.root)
    copy_array(source.local, target.local)
    copy_array(source.shared, target.shared)
    copy_array(source.position, target.position)
    copy_array(source.rotation, target.rotation)


@njit(cache=True)
def load_pose(root, local, shared, t, pose):
    """Copy frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P) into `pose`."""
    copy_array(root[t], pose.root)
    copy_array(local[t], pose.local)
    copy_array(shared[t], pose.shared)


@njit(cache=True)
def store_pose(pose, root, local, shared, t):
    """The reverse of `load`."""
    copy_array(pose.root, root[t])
    copy_array(pose.local, local[t])
    copy_array(pose.shared, shared[t])

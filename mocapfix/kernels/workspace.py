"""Working memory of one frame's solve, and copying the frame's pose into and out of it."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel
from mocapfix.kernels.forward_kinematics import FramePose, allocate_pose
from mocapfix.kernels.low_rank import RowResponses, allocate_row_responses
from mocapfix.kernels.normal_equations import NormalEquations, allocate_equations
from mocapfix.kernels.small_matrices import copy_array
from mocapfix.kernels.sweep import PoseStep, SweepFactors, allocate_factors, allocate_step


class SolveWorkspace(NamedTuple):
    """All arrays that the solve of a frame writes; allocated once for many frames."""

    pose: FramePose
    trial_pose: FramePose
    equations: NormalEquations
    factors: SweepFactors
    step: PoseStep
    row_responses: RowResponses | None  # None if no term writes rows
    g: np.ndarray  # (J, 6) gradient, overwritten by the sweep
    g_joint: np.ndarray  # (J, 3)


@compile_inner_kernel
def allocate_workspace(joints, unknowns, rows):
    """Return the workspace for so many joints, shared unknowns and rows; without rows (None) no code for them is compiled."""
    return SolveWorkspace(
        allocate_pose(joints, unknowns), allocate_pose(joints, unknowns), allocate_equations(joints, unknowns, rows),
        allocate_factors(joints, unknowns), allocate_step(joints, unknowns), allocate_row_responses(joints, unknowns, rows),
        np.empty((joints, 6)), np.empty((joints, 3)),
    )  # fmt: skip


@compile_inner_kernel
def copy_pose(source, target):
    """Copy a pose."""
    copy_array(source.root, target.root)
    copy_array(source.local, target.local)
    copy_array(source.shared, target.shared)
    copy_array(source.position, target.position)
    copy_array(source.rotation, target.rotation)


@compile_inner_kernel
def load_pose(root, local, shared, t, pose):
    """Copy frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P) into `pose`."""
    copy_array(root[t], pose.root)
    copy_array(local[t], pose.local)
    copy_array(shared[t], pose.shared)


@compile_inner_kernel
def store_pose(pose, root, local, shared, t):
    """Copy `pose` into frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P)."""
    copy_array(pose.root, root[t])
    copy_array(pose.local, local[t])
    copy_array(pose.shared, shared[t])

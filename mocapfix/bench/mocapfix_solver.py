"""mocapfix's own solver on the common task, and its Gauss-Newton direction by the sweep from the leaves to the root."""

# Compiled functions take arrays of any type, which numba infers.
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from mocapfix.bench.common_task import CommonTask, compute_zyx_rotations
from mocapfix.bench.scipy_solver import TimedSolution
from mocapfix.bench.scope_scenes import (
    DIRECTION_DAMPING,
    ScopeScene,
    build_empty_direction_term,
    build_empty_reprojection_term,
    build_placed_pose,
)
from mocapfix.kernels import levenberg_marquardt
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import solve_frames
from mocapfix.kernels.normal_equations import linearise_terms
from mocapfix.kernels.terms import PointTerm, TrackingTerm
from mocapfix.kernels.workspace import SolveWorkspace, allocate_workspace
from mocapfix.solve import parallel
from mocapfix.solve.parallel import run_over_frames

WINDOW_S = 0.625  # frames of a window are solved in sequence, windows in parallel
TASK_MARKER_SD_M = 0.002
WARM_START_DAMPING = 1e-6  # initial damping; small, because the previous frame is close
MAX_FRAME_ITERATIONS = 20


class TaskProblem(NamedTuple):
    """The body of the common task, the markers of a take, and the deviation of every joint from the mean pose."""

    tree: KinematicTree
    points: PointTerm
    tracking: TrackingTerm


def build_task_problem(task: CommonTask, take_name: str) -> TaskProblem:
    """Return the terms that the solver minimises for a take of the common task."""
    skeleton, joint_count, markers = task.subject.skeleton, len(task.mean_angles), task.takes[take_name]
    is_visible = ~np.isnan(markers[..., 0])
    measured = np.ascontiguousarray(np.where(is_visible[..., None], markers, 0.0))
    weight = np.ascontiguousarray(is_visible / TASK_MARKER_SD_M**2)
    points = PointTerm(task.subject.joints, task.subject.marker_offsets, measured, weight)
    tracking_weight = np.full((1, joint_count), (task.mean_pose_weight / TASK_MARKER_SD_M) ** 2)
    mean_rotations = compute_zyx_rotations(task.mean_angles)[None]
    tracking = TrackingTerm(mean_rotations, tracking_weight, np.zeros((1, 3)), np.zeros(1))
    return TaskProblem(KinematicTree(skeleton.parents, skeleton.offsets, np.ones(joint_count, bool)), points, tracking)


def solve_with_mocapfix(task: CommonTask, take_name: str, *, use_all_cores: bool) -> TimedSolution:
    """Return the poses of a take, on all cores (timed by the clock) or one thread (by processor time)."""
    tree, points, tracking = build_task_problem(task, take_name)
    frame_count, joint_count = len(points.measured), len(task.mean_angles)
    root, local = task.root_starts[take_name].copy(), np.tile(tracking.rotations, (frame_count, 1, 1, 1))
    order = parallel.order_in_windows(frame_count, joint_count, round(WINDOW_S * task.rate_hz))
    status, iterations = np.zeros((2, frame_count), int)
    arguments = (
        tree, (points, tracking), order, np.array([np.inf]), WARM_START_DAMPING, MAX_FRAME_ITERATIONS, None,
        root, local, np.zeros((frame_count, 0)), status, iterations,
    )  # fmt: skip
    clock = time.perf_counter if use_all_cores else time.thread_time
    started = clock()
    if use_all_cores:
        run_over_frames(solve_frames, len(order.chain_starts) - 1, *arguments)
    else:
        solve_frames(*arguments, 0, len(order.chain_starts) - 1)
    return TimedSolution(root, local, clock() - started)


def build_task_scene(task: CommonTask) -> ScopeScene:
    """Return the first frame of the clean take in the mean pose, as a scene whose direction can be computed."""
    tree, points, tracking = build_task_problem(task, "clean")
    pose = build_placed_pose(tree, task.root_starts["clean"][0], tracking.rotations[0])
    return ScopeScene(tree, points, build_empty_reprojection_term(), build_empty_direction_term(), tracking, pose)


def build_workspace(scene: ScopeScene) -> SolveWorkspace:
    """Return the arrays that the direction of a scene needs."""
    return allocate_workspace(len(scene.tree.parents), len(scene.tree.shape_basis), None)


@njit(cache=True)
def repeat_direction(tree, terms, pose, work, times):
    """Linearise all terms of a scene and solve for the Gauss-Newton step, repeatedly; write the step to the workspace."""
    for _ in range(times):
        linearise_terms(tree, terms, 0, np.inf, pose, work.equations)
        levenberg_marquardt.compute_direction(tree, work, DIRECTION_DAMPING)


def compute_sparse_direction(scene: ScopeScene, workspace: SolveWorkspace) -> Float[np.ndarray, " X"]:
    """Return the step (6 + 3 K + P,): rotation and translation of the root, rotations of the joints in world axes, shape."""
    repeat_direction(scene.tree, scene.terms, scene.pose, workspace, 1)
    return np.concatenate([workspace.step.twist[0], workspace.step.joint_turn[1:].ravel(), workspace.step.shared])


def time_sparse_direction(scene: ScopeScene, workspace: SolveWorkspace, repeats: int) -> float:
    """Return the processor time of one direction in seconds, as the mean of a compiled loop."""
    arguments = (scene.tree, scene.terms, scene.pose, workspace, repeats)
    started = time.thread_time()
    repeat_direction(*arguments)
    return (time.thread_time() - started) / repeats

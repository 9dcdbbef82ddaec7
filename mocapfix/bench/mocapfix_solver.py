"""mocapfix's own solver on the common task."""

import time

import numpy as np
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
from mocapfix.solve import frame_order
from mocapfix.solve.parallel import run_over_frames

# MERGED: mocapfix.bench.own
WINDOW_S = 0.625  # seconds that are solved one frame after the other; windows are solved side by side
TASK_MARKER_SD_M = 0.002  # metres
WARM_START_DAMPING = 1e-6  # initial damping: the frame before is a good start
MAX_FRAME_ITERATIONS = 20  # iterations of a frame


def build_task_problem(task: CommonTask, take_name: str) -> tuple[KinematicTree, PointTerm, TrackingTerm]:
    """-> the body, its markers in the take `name`, and the pull of every joint to the mean pose."""
    skeleton, joints, markers = task.subject.skeleton, len(task.mean_angles), task.takes[take_name]
    seen = ~np.isnan(markers[..., 0])
    measured = np.ascontiguousarray(np.where(seen[..., None], markers, 0.0))
    points = PointTerm(
        task.subject.joints, task.subject.marker_offsets, measured, np.ascontiguousarray(seen / TASK_MARKER_SD_M**2)
    )
    pull = TrackingTerm(
        compute_zyx_rotations(task.mean_angles)[None],
        np.full((1, joints), (task.mean_pose_weight / TASK_MARKER_SD_M) ** 2),
        np.zeros((1, 3)),
        np.zeros(1),
    )
    return KinematicTree(skeleton.parents, skeleton.offsets, np.ones(joints, bool)), points, pull


def solve_with_mocapfix(task: CommonTask, take_name: str, use_all_cores: bool) -> TimedSolution:
    """-> all frames of the take `name`, on one thread (timed by what the processor spent) or on every core (by the clock)."""
    tree, points, pull = build_task_problem(task, take_name)
    frames, joints = len(points.measured), len(task.mean_angles)
    root, local = task.root_starts[take_name].copy(), np.tile(pull.rotations, (frames, 1, 1, 1))
    windows = frame_order.order_in_windows(frames, joints, round(WINDOW_S * task.rate_hz))
    status, iterations = np.zeros((2, frames), int)
    given = (
        tree, (points, pull), windows, np.array([np.inf]), WARM_START_DAMPING, MAX_FRAME_ITERATIONS, None,
        root, local, np.zeros((frames, 0)), status, iterations,
    )  # fmt: skip
    clock = time.perf_counter if use_all_cores else time.thread_time
    started = clock()
    if use_all_cores:
        run_over_frames(solve_frames, len(windows.chain_starts) - 1, *given)
    else:
        solve_frames(*given, 0, len(windows.chain_starts) - 1)
    return TimedSolution(root, local, clock() - started)


def build_task_scene(task: CommonTask) -> ScopeScene:
    """-> the clean take's first frame in the mean pose, as a scene whose direction can be asked for."""
    tree, points, pull = build_task_problem(task, "clean")
    pose = build_placed_pose(tree, task.root_starts["clean"][0], pull.rotations[0])
    return ScopeScene(tree, points, build_empty_reprojection_term(), build_empty_direction_term(), pull, pose)


# MERGED: mocapfix.bench.sparse
# The direction as mocapfix computes it: the leaves-to-root sweep, in O(K) + O(N).
def build_workspace(scene: ScopeScene) -> SolveWorkspace:
    """-> arrays for the scene's direction."""
    return allocate_workspace(len(scene.tree.parents), len(scene.tree.shape_basis), None)


@njit(cache=True)
def repeat_direction(tree, terms, pose, work, times):
    """Linearise all terms of a scene and solve for the Gauss-Newton step, into the work's step; so many times."""
    for _ in range(times):
        linearise_terms(tree, terms, 0, np.inf, pose, work.equations)
        levenberg_marquardt.compute_direction(tree, work, DIRECTION_DAMPING)


def compute_sparse_direction(scene: ScopeScene, workspace: SolveWorkspace) -> np.ndarray:
    """-> x (6 + 3 K + P,): the root's turn and shift, every joint's turn, all in world axes, the shape parameters."""
    repeat_direction(scene.tree, scene.terms, scene.pose, workspace, 1)
    return np.concatenate([workspace.step.twist[0], workspace.step.joint_turn[1:].ravel(), workspace.step.shared])


def time_sparse_direction(scene: ScopeScene, workspace: SolveWorkspace, repeats: int) -> float:
    """-> what one direction costs the processor, the mean of so many in a compiled loop."""
    given = (scene.tree, scene.terms, scene.pose, workspace, repeats)
    started = time.thread_time()
    repeat_direction(*given)
    return (time.thread_time() - started) / repeats

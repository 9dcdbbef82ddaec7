"""The solvers of the common task: scipy's least_squares as the baseline, and mocapfix's own solver.

The baseline uses an analytic Jacobian, frame by frame. The unknowns of a frame are the root position and the Euler angles z, y, x
of every joint; the method "lm" is MINPACK's. The Gauss-Newton direction of mocapfix is computed by the sweep from the leaves to
the root.
"""

import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy.optimize import least_squares

from mocapfix.bench.common_task import CommonTask, compute_zyx_rotations
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


class TimedSolution(NamedTuple):
    """Solved poses and the time that they took."""

    root_position: np.ndarray  # (T, 3) metres
    rotations: np.ndarray  # (T, J, 3, 3) local
    duration_s: float  # processor time unless several threads were used, so that other programs do not matter


class PlacedMarkers(NamedTuple):
    """The body in one frame."""

    joint_positions: np.ndarray  # (J, 3) metres
    marker_positions: np.ndarray  # (M, 3) metres
    angle_axes: np.ndarray  # (J, 3, 3): the world axes of each joint's three Euler angles


def solve_with_scipy(task: CommonTask, take_name: str, frame_count: int) -> TimedSolution:
    """Return the poses of the first frames of a take, each started from the previous one."""
    joint_count = len(task.mean_angles)
    mean = task.mean_angles.ravel()
    x = np.concatenate([task.root_starts[take_name][0], mean])
    moves_marker = find_moving_joints(task)
    prior_jacobian = np.hstack([np.zeros((3 * joint_count, 3)), task.mean_pose_weight * np.eye(3 * joint_count)])
    solution, started = np.empty((frame_count, len(x))), time.thread_time()
    for t, measured in enumerate(task.takes[take_name][:frame_count]):
        is_visible = ~np.isnan(measured[:, 0])

        def residual(x: np.ndarray, measured: np.ndarray = measured, is_visible: np.ndarray = is_visible) -> np.ndarray:
            marker_residuals = (place_markers(task, x).marker_positions - measured)[is_visible].ravel()
            return np.concatenate([marker_residuals, task.mean_pose_weight * (x[3:] - mean)])

        def jacobian(x: np.ndarray, is_visible: np.ndarray = is_visible) -> np.ndarray:
            marker_jacobian = compute_marker_jacobian(place_markers(task, x), moves_marker)[is_visible]
            return np.concatenate([marker_jacobian.reshape(-1, len(x)), prior_jacobian])

        # The stubs do not allow a function as the Jacobian.
        fit = least_squares(residual, x, jacobian, method="lm", xtol=1e-5, ftol=1e-6, gtol=1e-8)  # pyright: ignore
        solution[t] = x = fit.x
    duration_s = time.thread_time() - started
    rotations = compute_zyx_rotations(solution[:, 3:].reshape(frame_count, joint_count, 3))
    return TimedSolution(solution[:, :3], rotations, duration_s)


def place_markers(task: CommonTask, unknowns: Float[np.ndarray, " X"]) -> PlacedMarkers:
    """Return the body for the unknowns (3 + 3 J,)."""
    skeleton, angles = task.subject.skeleton, unknowns[3:].reshape(-1, 3)
    local, position = compute_zyx_rotations(angles), np.empty(angles.shape)
    rotation = np.empty((len(angles), 3, 3))
    parent_rotation = np.empty_like(rotation)
    for j, p in enumerate(skeleton.parents):
        parent_rotation[j] = rotation[p] if j else np.eye(3)
        rotation[j] = parent_rotation[j] @ local[j]
        position[j] = position[p] + rotation[p] @ skeleton.offsets[j] if j else unknowns[:3]
    joints = task.subject.joints
    markers = position[joints] + (rotation[joints] @ task.subject.marker_offsets[:, :, None])[:, :, 0]
    # The axis of z is the parent's, that of y is rotated by z, that of x is the joint's own.
    c, s = np.cos(angles[:, :1]), np.sin(angles[:, :1])
    y_axis = c * parent_rotation[:, :, 1] - s * parent_rotation[:, :, 0]
    axes = np.stack([parent_rotation[:, :, 2], y_axis, rotation[:, :, 0]], axis=1)
    return PlacedMarkers(position, markers, axes)


def compute_marker_jacobian(placed: PlacedMarkers, moves_marker: Bool[np.ndarray, "M J"]) -> Float[np.ndarray, "M 3 X"]:
    """Return the derivatives (M, 3, 3 + 3 J) of every marker with respect to root position and Euler angles."""
    lever = (placed.marker_positions[:, None] - placed.joint_positions) * moves_marker[..., None]
    ax, ay, az = np.moveaxis(placed.angle_axes, -1, 0)
    x, y, z = np.moveaxis(lever[:, :, None], -1, 0)
    jacobian = np.empty((len(moves_marker), 3, 3 + 3 * moves_marker.shape[1]))
    jacobian[:, :, :3] = np.eye(3)
    for row, part in enumerate((ay * z - az * y, az * x - ax * z, ax * y - ay * x)):
        jacobian[:, row, 3:] = part.reshape(len(moves_marker), -1)
    return jacobian


def find_moving_joints(task: CommonTask) -> Bool[np.ndarray, "M J"]:
    """Return which joints move each marker: the joint that it is attached to, and all ancestors."""
    parents, marker_joints = task.subject.skeleton.parents, task.subject.joints
    moves_marker = np.zeros((len(marker_joints), len(parents)), bool)
    for marker, joint in enumerate(marker_joints):
        while joint >= 0:
            moves_marker[marker, joint] = True
            joint = parents[joint]
    return moves_marker


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
def repeat_direction(tree: KinematicTree, terms: Any, pose: Any, work: SolveWorkspace, times: int) -> None:
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

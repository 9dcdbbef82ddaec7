"""The solvers of the common task: scipy's least_squares as the baseline, and mocapfix's own solver.

The baseline uses an analytic Jacobian, frame by frame. The unknowns of a frame are the root position and the Euler angles z, y, x
of every joint; the method "lm" is MINPACK's. The Gauss-Newton direction of mocapfix is computed by the sweep from the leaves to
the root.

What runs on one thread is timed by processor time, so that other programs do not matter; only what runs on all cores is timed by
the clock.
"""

import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import PointTerm, TrackingTerm
from mocapfix.lab.common_task import CommonTask, build_common_task, compute_zyx_rotations
from mocapfix.model.system import THREADS_VARIABLE, count_cores
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.parallel import SolveOrder


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
    start = task.root_starts[take_name], np.tile(tracking.rotations, (frame_count, 1, 1, 1))
    frames, window = np.arange(frame_count), round(WINDOW_S * task.rate_hz)
    start_frame = np.where(frames % window == 0, -1, frames - 1)
    order = SolveOrder(frames, start_frame, np.ones((1, joint_count), bool), np.r_[frames[::window], frame_count])
    settings = SolverSettings(max_iterations=MAX_FRAME_ITERATIONS, damping_ratio=WARM_START_DAMPING, order=order)
    clock = time.perf_counter if use_all_cores else time.process_time
    with patch.dict(os.environ, {} if use_all_cores else {THREADS_VARIABLE: "1"}):
        started = clock()
        solution = minimise(tree, (points, tracking), start, settings)
        return TimedSolution(*solution.poses, clock() - started)


ONE_THREAD_ENVIRONMENT: dict[str, str] = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TASK_TAKE_NAMES = ("clean", "noisy")


class TimingEffort(NamedTuple):
    """The number of repetitions of every measurement."""

    rounds: int  # the fastest round counts
    samples_per_round: int  # the median of a round counts
    scipy_frame_count: int  # frames of the common task that scipy solves


FULL_EFFORT = TimingEffort(rounds=5, samples_per_round=9, scipy_frame_count=150)
QUICK_EFFORT = TimingEffort(rounds=1, samples_per_round=3, scipy_frame_count=8)


def measure_in_fresh_process(is_quick: bool) -> dict[str, Any]:
    """Return the results of `measure_common_task`, run in a new process in which BLAS uses one thread.

    BLAS reads its number of threads when it is loaded, which has already happened in this process.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD_ENVIRONMENT}
    os.environ.update(ONE_THREAD_ENVIRONMENT)
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            return process.submit(measure_common_task, QUICK_EFFORT if is_quick else FULL_EFFORT).result()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def measure_common_task(effort: TimingEffort) -> dict[str, Any]:
    """Return frames per second and joint errors of mocapfix and of scipy."""
    task = build_common_task()
    one_thread_fps, all_threads_fps, scipy_fps = dict[str, float](), dict[str, float](), dict[str, float]()
    joint_error_mm, scipy_joint_error_mm = dict[str, float](), dict[str, float]()
    for name in TASK_TAKE_NAMES:

        def time_solve(use_all_cores: bool, name: str = name) -> float:
            return solve_with_mocapfix(task, name, use_all_cores=use_all_cores).duration_s

        frame_count, solution = len(task.takes[name]), solve_with_mocapfix(task, name, use_all_cores=False)
        samples = [lambda use_all_cores=use_all_cores: time_solve(use_all_cores) for use_all_cores in (False, True)]
        one_thread_s, all_threads_s = time_samples(samples, effort)
        one_thread_fps[name], all_threads_fps[name] = frame_count / one_thread_s, frame_count / all_threads_s
        joint_error_mm[name] = 1e3 * task.compute_joint_error(solution.root_position, solution.rotations)
        baseline = solve_with_scipy(task, name, effort.scipy_frame_count)
        scipy_fps[name] = effort.scipy_frame_count / baseline.duration_s
        scipy_joint_error_mm[name] = 1e3 * task.compute_joint_error(baseline.root_position, baseline.rotations)
    return {
        "threads": count_cores(),
        "fps_one_thread": one_thread_fps,
        "fps_all_threads": all_threads_fps,
        "joint_error_mm": joint_error_mm,
        "over_scipy": {name: one_thread_fps[name] / scipy_fps[name] for name in TASK_TAKE_NAMES},
        "scipy_fps": scipy_fps,
        "scipy_frames": effort.scipy_frame_count,
        "scipy_joint_error_mm": scipy_joint_error_mm,
    }


def time_samples(samples: list[Callable[[], float]], effort: TimingEffort) -> list[float]:
    """Return the seconds of each sample: the minimum over rounds of the median of a round.

    All samples are measured in every round, so that a period of other load does not affect only one of them.
    """
    rounds = [
        [np.median([sample() for _ in range(effort.samples_per_round)]) for sample in samples] for _ in range(effort.rounds)
    ]
    return [float(each) for each in np.min(rounds, axis=0)]

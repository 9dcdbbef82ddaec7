"""The solvers of the common task: scipy's least_squares as the baseline, and mocapfix's own solver.

The baseline uses an analytic Jacobian, frame by frame. The unknowns of a frame are the root position and the Euler angles z, y, x
of every joint; the method "lm" is MINPACK's. The Gauss-Newton direction of mocapfix is computed by the sweep from the leaves to
the root.

The Gauss-Newton direction by the usual dense method: one Jacobian of all measurements, its product, a Cholesky solve.

This is SCOPE's "dense unconstrained formulation" (Eq. 11 and section A.1) in O(K^3) + O(K^2 N), with its fastest implementation:
the Jacobian in compiled code, the product by BLAS (syrk), the solve by LAPACK (posv).

The benchmark of the solver's speed: the common task in comparison with scipy, and SCOPE's experiments with a dense direction.

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
from numba import njit
from scipy.linalg.blas import dgemv, dsyrk  # pyright: ignore[reportAttributeAccessIssue]  # not in the stubs
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]  # not in the stubs
from scipy.optimize import least_squares

from mocapfix.kernels import levenberg_marquardt
from mocapfix.kernels.compilation import THREADS_VARIABLE, count_cores
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.normal_equations import allocate_equations, linearise_terms
from mocapfix.kernels.small_matrices import load_matrix, multiply_vector
from mocapfix.kernels.terms import PointTerm, TrackingTerm
from mocapfix.kernels.workspace import SolveWorkspace, allocate_workspace
from mocapfix.lab.common_task import CommonTask, build_common_task, compute_zyx_rotations
from mocapfix.lab.scope_scenes import (
    DIRECTION_DAMPING,
    SCOPE_JOINT_COUNTS,
    ScopeScene,
    build_empty_direction_term,
    build_empty_reprojection_term,
    build_placed_pose,
    build_scope_experiments,
)
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.parallel import order_sequentially


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
    order = order_sequentially(np.arange(frame_count) % round(WINDOW_S * task.rate_hz) == 0, joint_count)
    settings = SolverSettings(max_iterations=MAX_FRAME_ITERATIONS, damping_ratio=WARM_START_DAMPING, order=order)
    clock = time.perf_counter if use_all_cores else time.process_time
    with patch.dict(os.environ, {} if use_all_cores else {THREADS_VARIABLE: "1"}):
        started = clock()
        solution = minimise(tree, (points, tracking), start, settings)
        return TimedSolution(*solution.poses, clock() - started)


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


# Compiled functions take arrays of any type, which numba infers.
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false


class DenseSolver:
    """The dense direction of one scene, with preallocated arrays.

    The unknowns (6 + 3 K + P,) are rotation and translation of the root, rotations of the joints in world axes, and the shape
    parameters.
    """

    def __init__(self, scene: ScopeScene) -> None:
        joint_count, shape_count = len(scene.tree.parents), len(scene.tree.shape_basis)
        self.scene, self.tracking_system = scene, allocate_equations(joint_count, shape_count, None)
        self.jacobian = np.empty((scene.measurement_count, 3 + 3 * joint_count + shape_count))
        self.residual = np.empty(scene.measurement_count)
        self.shape_motion = np.zeros((shape_count, joint_count, 3))

    def compute_direction(self) -> Float[np.ndarray, " X"]:
        """Return the Gauss-Newton step."""
        tree, points, views, directions, tracking, pose = self.scene
        write_jacobian(tree, (points, views, directions), pose, self.shape_motion, self.jacobian, self.residual)
        transposed = self.jacobian.T  # column-major, as Fortran expects
        curvature, gradient = dsyrk(1.0, transposed, lower=1), dgemv(1.0, transposed, self.residual)
        add_dense_tracking_term(tree, (tracking,), pose, self.tracking_system, curvature, gradient)
        return -dposv(curvature, gradient, lower=1, overwrite_a=1, overwrite_b=1)[1]

    def time_direction(self) -> float:
        """Return the processor time of one direction in seconds."""
        started = time.thread_time()
        self.compute_direction()
        return time.thread_time() - started


@njit(cache=True)
def write_shape_motion(tree, rotation, shape_motion):
    """Write the derivatives (P, J, 3) of joint positions with respect to the shape parameters, in the world."""
    for p in range(len(shape_motion)):
        for j in range(1, len(tree.parents)):
            parent, axis = tree.parents[j], tree.shape_basis[p, j]
            x, y, z = multiply_vector(load_matrix(rotation, parent), axis[0], axis[1], axis[2])
            shape_motion[p, j, 0] = shape_motion[p, parent, 0] + x
            shape_motion[p, j, 1] = shape_motion[p, parent, 1] + y
            shape_motion[p, j, 2] = shape_motion[p, parent, 2] + z


@njit(cache=True)
def write_jacobian_row(pose_of_tree, shape_motion, j, point, derivatives, out):
    """Write one row of the Jacobian, of a value that depends on the position of a point and the rotation of body j.

    `pose_of_tree` is the tree and its joint positions, `point` the position from the root, and `derivatives` those with respect
    to rotation and position.
    """
    (tree, position), (x, y, z), (turn, shift) = pose_of_tree, point, derivatives
    out[:] = 0.0
    tx, ty, tz = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
    tx, ty, tz = turn[0] + tx, turn[1] + ty, turn[2] + tz
    unknowns, shapes, end = len(out), len(shape_motion), j
    while j > 0:  # a joint rotates all its descendants about its position
        dx, dy, dz = position[j, 0] - position[0, 0], position[j, 1] - position[0, 1], position[j, 2] - position[0, 2]
        out[3 + 3 * j] = tx + dz * shift[1] - dy * shift[2]
        out[4 + 3 * j] = ty + dx * shift[2] - dz * shift[0]
        out[5 + 3 * j] = tz + dy * shift[0] - dx * shift[1]
        j = tree.parents[j]
    out[0], out[1], out[2], out[3], out[4], out[5] = tx, ty, tz, shift[0], shift[1], shift[2]
    for p in range(shapes):
        s = shape_motion[p, end]
        out[unknowns - shapes + p] = shift[0] * s[0] + shift[1] * s[1] + shift[2] * s[2]


@njit(cache=True)
def write_jacobian(tree, terms, pose, shape_motion, jacobian, residual):
    """Write the Jacobian (N, 6 + 3 K + P) and the residuals (N,) of all measurements, in units of their standard deviations."""
    points, views, directions = terms
    position, rotation, row, zero, turn, shift = pose.position, pose.rotation, 0, np.zeros(3), np.zeros(3), np.zeros(3)
    write_shape_motion(tree, rotation, shape_motion)
    for n in range(len(points.joints)):
        j, offset, scale = points.joints[n], points.offsets[n], np.sqrt(points.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2])
        point = (x + position[j, 0], y + position[j, 1], z + position[j, 2])
        for a in range(3):
            shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
            shift[a] = scale
            residual[row] = scale * (point[a] - points.measured[0, n, a])
            from_root = (point[0] - position[0, 0], point[1] - position[0, 1], point[2] - position[0, 2])
            write_jacobian_row((tree, position), shape_motion, j, from_root, (zero, shift), jacobian[row])
            row += 1
    for n in range(len(views.joints)):
        j, offset, scale = views.joints[n], views.offsets[n], np.sqrt(views.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2])
        x, y, z = x + position[j, 0], y + position[j, 1], z + position[j, 2]
        m, origin = views.rotation[views.cameras[n]], views.translation[views.cameras[n]]
        image = multiply_vector(load_matrix(views.rotation, views.cameras[n]), x, y, z)
        depth = image[2] + origin[2]
        for a in range(2):
            projected = (image[a] + origin[a]) / depth
            for c in range(3):
                shift[c] = scale * (m[a, c] - projected * m[2, c]) / depth
            residual[row] = scale * (projected - views.measured[0, n, a])
            from_root = (x - position[0, 0], y - position[0, 1], z - position[0, 2])
            write_jacobian_row((tree, position), shape_motion, j, from_root, (zero, shift), jacobian[row])
            row += 1
    shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
    for n in range(len(directions.joints)):
        j, axis, scale = directions.joints[n], directions.bone_axes[n], np.sqrt(directions.weight[0, n])
        d = multiply_vector(load_matrix(rotation, j), axis[0], axis[1], axis[2])
        for a in range(3):  # a rotation w moves the direction by w x d
            b, c = (a + 1) % 3, (a + 2) % 3
            turn[a], turn[b], turn[c] = 0.0, scale * d[c], -scale * d[b]
            residual[row] = scale * (d[a] - directions.measured[0, n, a])
            write_jacobian_row((tree, position), shape_motion, j, (0.0, 0.0, 0.0), (turn, shift), jacobian[row])
            row += 1


@njit(cache=True)
def add_dense_tracking_term(tree, terms, pose, system, curvature, gradient):
    """Add the tracking term of every joint, and the damping of the sweep."""
    linearise_terms(tree, terms, 0, np.inf, pose, system)
    for j in range(len(tree.parents)):
        row = 3 + 3 * j if j else 0
        for a in range(3):
            gradient[row + a] += system.g_joint[j, a] if j else system.g[0, a]
            for c in range(a + 1):
                curvature[row + a, row + c] += system.h_joint[j, a, c]
    for i in range(len(gradient)):
        curvature[i, i] += DIRECTION_DAMPING


ONE_THREAD_ENVIRONMENT: dict[str, str] = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TASK_TAKE_NAMES = ("clean", "noisy")


class TimingEffort(NamedTuple):
    """The number of repetitions of every measurement."""

    rounds: int  # the fastest round counts
    samples_per_round: int  # the median of a round counts
    directions_per_sample: int  # by the sweep
    scipy_frame_count: int  # frames of the common task that scipy solves


FULL_EFFORT = TimingEffort(rounds=5, samples_per_round=9, directions_per_sample=20, scipy_frame_count=150)
QUICK_EFFORT = TimingEffort(rounds=1, samples_per_round=3, directions_per_sample=5, scipy_frame_count=8)


def measure_in_fresh_process(is_quick: bool) -> dict[str, Any]:
    """Return the results of `measure_solver_speed`, run in a new process in which BLAS uses one thread.

    BLAS reads its number of threads when it is loaded, which has already happened in this process.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD_ENVIRONMENT}
    os.environ.update(ONE_THREAD_ENVIRONMENT)
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            return process.submit(measure_solver_speed, QUICK_EFFORT if is_quick else FULL_EFFORT).result()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def measure_solver_speed(effort: TimingEffort) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON."""
    settings, scenes = (list(each) for each in zip(*build_scope_experiments(), strict=True))
    *times, task_times = time_directions([*scenes, build_task_scene(build_common_task())], effort)
    rows = [row | each | {"speedup": each["dense_us"] / each["sparse_us"]} for row, each in zip(settings, times, strict=True)]
    by_size = {(row["joints"], row["shapes"]): row for row in rows if row["experiment"] == 3}
    small, large = (by_size[joints, 0] for joints in SCOPE_JOINT_COUNTS)  # both have the same measurements per joint
    columns = {"23": small, "31": task_times, "51": large}
    return measure_common_task(effort) | {
        "direction_us": {joints: row["sparse_us"] for joints, row in columns.items()},
        "dense_direction_us": {joints: row["dense_us"] for joints, row in columns.items()},
        "k51_over_k23": large["sparse_us"] / small["sparse_us"],
        "dense_k51_over_k23": large["dense_us"] / small["dense_us"],
        "sparse_speedup_k23": compute_speedup(rows, 1, 23),
        "sparse_speedup_k51": compute_speedup(rows, 1, 51),
        "sparse_speedup_k23_shapes": compute_speedup(rows, 2, 23),
        "sparse_speedup_k51_shapes": compute_speedup(rows, 2, 51),
        "experiments": rows,
    }


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


def time_directions(scenes: list[ScopeScene], effort: TimingEffort) -> list[dict[str, float]]:
    """Return the microseconds of one direction of each scene, by the sweep and dense."""
    samples: list[Callable[[], float]] = []
    for scene in scenes:
        workspace, dense = build_workspace(scene), DenseSolver(scene)

        def time_sweep(scene: ScopeScene = scene, workspace: Any = workspace) -> float:
            return time_sparse_direction(scene, workspace, effort.directions_per_sample)

        time_sparse_direction(scene, workspace, 1)  # compiles
        dense.compute_direction()
        samples += [time_sweep, dense.time_direction]
    us = [1e6 * seconds for seconds in time_samples(samples, effort)]
    return [{"sparse_us": sparse, "dense_us": dense} for sparse, dense in zip(us[::2], us[1::2], strict=True)]


def time_samples(samples: list[Callable[[], float]], effort: TimingEffort) -> list[float]:
    """Return the seconds of each sample: the minimum over rounds of the median of a round.

    All samples are measured in every round, so that a period of other load does not affect only one of them.
    """
    rounds = [
        [np.median([sample() for _ in range(effort.samples_per_round)]) for sample in samples] for _ in range(effort.rounds)
    ]
    return [float(each) for each in np.min(rounds, axis=0)]


def compute_speedup(rows: list[dict[str, Any]], experiment: int, joint_count: int) -> float:
    """Return the ratio of dense to sparse time, as the geometric mean over an experiment."""
    ratios = [row["speedup"] for row in rows if (row["experiment"], row["joints"]) == (experiment, joint_count)]
    return float(np.exp(np.mean(np.log(ratios))))

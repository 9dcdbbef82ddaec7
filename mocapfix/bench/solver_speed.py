"""The benchmark of the solver's speed: the common task in comparison with scipy, and SCOPE's experiments with a dense direction.

What runs on one thread is timed by processor time, so that other programs do not matter; only what runs on all cores is timed by
the clock.
"""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np

from mocapfix.bench.common_task import build_common_task
from mocapfix.bench.compared_solvers import (
    build_task_scene,
    build_workspace,
    solve_with_mocapfix,
    solve_with_scipy,
    time_sparse_direction,
)
from mocapfix.bench.dense_solver import DenseSolver
from mocapfix.bench.scope_scenes import SCOPE_JOINT_COUNTS, ScopeScene, build_scope_experiments
from mocapfix.kernels.precompilation import count_cores

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

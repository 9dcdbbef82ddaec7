"""How fast the solver is: on the common task beside scipy, and SCOPE's experiments beside the dense direction.

Whatever runs on one thread is timed by what the processor spent on it, so that a busy machine does not slow it; only what
runs on every core is timed by the clock.
"""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from mocapfix.bench import common_task, scipy_solver, scope_scenes
from mocapfix.bench import mocapfix_solver as own
from mocapfix.bench import mocapfix_solver as sparse
from mocapfix.bench.dense_solver import DenseSolver
from mocapfix.bench.scope_scenes import ScopeScene
from mocapfix.solve.parallel import count_cores

ONE_THREAD_ENVIRONMENT: dict[str, str] = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TASK_TAKE_NAMES = ("clean", "noisy")


class TimingEffort(NamedTuple):
    """How often everything is timed."""

    rounds: int  # of which the fastest counts
    samples_per_round: int  # in each round, of which the median counts
    directions_per_sample: int  # of the sweep in each sample
    scipy_frame_count: int  # of the common task that the peer solves


FULL_EFFORT, QUICK_EFFORT = TimingEffort(5, 9, 20, 150), TimingEffort(1, 3, 5, 8)


def measure_in_fresh_process(is_quick: bool) -> dict:
    """-> what `measure` does, from a fresh process in which BLAS knows of one thread only.

    BLAS reads that when it is loaded, which here it already has been.
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


def measure_solver_speed(effort: TimingEffort) -> dict:
    """-> every figure of the benchmark, ready for JSON."""
    rows, scenes = (list(each) for each in zip(*scope_scenes.build_scope_experiments(), strict=True))
    *times, here = time_directions([*scenes, own.build_task_scene(common_task.build_common_task())], effort)
    rows = [row | each | {"speedup": each["dense_us"] / each["sparse_us"]} for row, each in zip(rows, times, strict=True)]
    alike = {(row["joints"], row["shapes"]): row for row in rows if row["experiment"] == 3}
    small, large = (alike[joints, 0] for joints in scope_scenes.SCOPE_JOINT_COUNTS)  # as many measurements a joint in both
    columns = {"23": small, "31": here, "51": large}
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


def measure_common_task(effort: TimingEffort) -> dict:
    """-> frames a second and joint errors of mocapfix and of scipy."""
    task, one, every, errors, theirs, their_errors = common_task.build_common_task(), {}, {}, {}, {}, {}
    for name in TASK_TAKE_NAMES:
        frames, solved = len(task.takes[name]), own.solve_with_mocapfix(task, name, False)
        alone, together = time_samples(
            [lambda n=name, e=each: own.solve_with_mocapfix(task, n, e).duration_s for each in (False, True)], effort
        )
        one[name], every[name] = frames / alone, frames / together
        errors[name] = 1e3 * task.compute_joint_error(solved.root_position, solved.rotations)
        plain = scipy_solver.solve_with_scipy(task, name, effort.scipy_frame_count)
        theirs[name] = effort.scipy_frame_count / plain.duration_s
        their_errors[name] = 1e3 * task.compute_joint_error(plain.root_position, plain.rotations)
    return {
        "threads": count_cores(),
        "fps_one_thread": one,
        "fps_all_threads": every,
        "joint_error_mm": errors,
        "over_scipy": {name: one[name] / theirs[name] for name in TASK_TAKE_NAMES},
        "scipy_fps": theirs,
        "scipy_frames": effort.scipy_frame_count,
        "scipy_joint_error_mm": their_errors,
    }


def time_directions(scenes: list[ScopeScene], effort: TimingEffort) -> list[dict[str, float]]:
    """-> microseconds of one direction of each scene, by the sweep and dense."""
    samples = []
    for scene in scenes:
        work, dense = sparse.build_workspace(scene), DenseSolver(scene)
        sparse.time_sparse_direction(scene, work, 1)
        dense.compute_direction()
        samples += [
            lambda s=scene, w=work: sparse.time_sparse_direction(s, w, effort.directions_per_sample),
            dense.time_direction,
        ]
    us = [1e6 * seconds for seconds in time_samples(samples, effort)]
    return [{"sparse_us": sweeping, "dense_us": densely} for sweeping, densely in zip(us[::2], us[1::2], strict=True)]


def time_samples(samples: list[Callable[[], float]], effort: TimingEffort) -> list[float]:
    """-> seconds of each: the least of the medians, so that neither a lucky moment nor a busy machine counts.

    All of them have their turn in every round, so that a busy while is no one's alone.
    """
    rounds = [
        [np.median([sample() for _ in range(effort.samples_per_round)]) for sample in samples] for _ in range(effort.rounds)
    ]
    return [float(each) for each in np.min(rounds, axis=0)]


def compute_speedup(rows: list[dict], experiment: int, joints: int) -> float:
    """-> dense over sparse, the geometric mean over an experiment's course."""
    ratios = [row["speedup"] for row in rows if (row["experiment"], row["joints"]) == (experiment, joints)]
    return float(np.exp(np.mean(np.log(ratios))))

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

from mocapfix.bench import common_task, own, peer, scope, sparse
from mocapfix.bench.dense import Dense
from mocapfix.bench.scene import Scene
from mocapfix.kernels.threads import cores

ONE_THREAD: dict[str, str] = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
TAKES = ("clean", "noisy")


class Effort(NamedTuple):
    """How often everything is timed."""

    rounds: int  # of which the fastest counts
    samples: int  # in each round, of which the median counts
    directions: int  # of the sweep in each sample
    frames: int  # of the common task that the peer solves


FULL, QUICK = Effort(5, 9, 20, 150), Effort(1, 3, 5, 8)


def alone(quick: bool) -> dict:
    """-> what `measure` does, from a fresh process in which BLAS knows of one thread only.

    BLAS reads that when it is loaded, which here it already has been.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            return process.submit(measure, QUICK if quick else FULL).result()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def measure(effort: Effort) -> dict:
    """-> every figure of the benchmark, ready for JSON."""
    rows, scenes = (list(each) for each in zip(*scope.experiments(), strict=True))
    *times, here = timed([*scenes, own.scene(common_task.make())], effort)
    rows = [row | each | {"speedup": each["dense_us"] / each["sparse_us"]} for row, each in zip(rows, times, strict=True)]
    alike = {(row["joints"], row["shapes"]): row for row in rows if row["experiment"] == 3}
    small, large = (alike[joints, 0] for joints in scope.JOINTS)  # as many measurements a joint in both
    columns = {"23": small, "31": here, "51": large}
    return on_common_task(effort) | {
        "direction_us": {joints: row["sparse_us"] for joints, row in columns.items()},
        "dense_direction_us": {joints: row["dense_us"] for joints, row in columns.items()},
        "k51_over_k23": large["sparse_us"] / small["sparse_us"],
        "dense_k51_over_k23": large["dense_us"] / small["dense_us"],
        "sparse_speedup_k23": speedup(rows, 1, 23),
        "sparse_speedup_k51": speedup(rows, 1, 51),
        "sparse_speedup_k23_shapes": speedup(rows, 2, 23),
        "sparse_speedup_k51_shapes": speedup(rows, 2, 51),
        "experiments": rows,
    }


def on_common_task(effort: Effort) -> dict:
    """-> frames a second and joint errors of mocapfix and of scipy."""
    task, one, every, errors, theirs, their_errors = common_task.make(), {}, {}, {}, {}, {}
    for name in TAKES:
        frames, solved = len(task.takes[name]), own.solve(task, name, False)
        alone, together = least([lambda n=name, e=each: own.solve(task, n, e).seconds for each in (False, True)], effort)
        one[name], every[name] = frames / alone, frames / together
        errors[name] = 1e3 * task.error(solved.root, solved.rotations)
        plain = peer.solve(task, name, effort.frames)
        theirs[name] = effort.frames / plain.seconds
        their_errors[name] = 1e3 * task.error(plain.root, plain.rotations)
    return {
        "threads": cores(),
        "fps_one_thread": one,
        "fps_all_threads": every,
        "joint_error_mm": errors,
        "over_scipy": {name: one[name] / theirs[name] for name in TAKES},
        "scipy_fps": theirs,
        "scipy_frames": effort.frames,
        "scipy_joint_error_mm": their_errors,
    }


def timed(scenes: list[Scene], effort: Effort) -> list[dict[str, float]]:
    """-> microseconds of one direction of each scene, by the sweep and dense."""
    samples = []
    for scene in scenes:
        work, dense = sparse.work(scene), Dense(scene)
        sparse.seconds(scene, work, 1)
        dense.direction()
        samples += [lambda s=scene, w=work: sparse.seconds(s, w, effort.directions), dense.seconds]
    us = [1e6 * seconds for seconds in least(samples, effort)]
    return [{"sparse_us": sweeping, "dense_us": densely} for sweeping, densely in zip(us[::2], us[1::2], strict=True)]


def least(samples: list[Callable[[], float]], effort: Effort) -> list[float]:
    """-> seconds of each: the least of the medians, so that neither a lucky moment nor a busy machine counts.

    All of them have their turn in every round, so that a busy while is no one's alone.
    """
    rounds = [[np.median([sample() for _ in range(effort.samples)]) for sample in samples] for _ in range(effort.rounds)]
    return [float(each) for each in np.min(rounds, axis=0)]


def speedup(rows: list[dict], experiment: int, joints: int) -> float:
    """-> dense over sparse, the geometric mean over an experiment's course."""
    ratios = [row["speedup"] for row in rows if (row["experiment"], row["joints"]) == (experiment, joints)]
    return float(np.exp(np.mean(np.log(ratios))))

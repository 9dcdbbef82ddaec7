"""Benchmark of whole cleans: the cost of `mocapfix clean` on composed files, relative to the solver's own rate.

Every file is cleaned as a user does it, in a process of its own, with its start and its imports. The solver is timed on the
common task before and after each clean. Costs are compared in processor time, because other programs on the machine change that
much less than the time by the clock, and because it does not depend on the number of cores.
"""

import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

import mocapfix
from mocapfix import synthetic
from mocapfix.bench.common_task import CommonTask, build_common_task
from mocapfix.bench.compared_solvers import solve_with_mocapfix
from mocapfix.bench.injected_animation_faults import inject_animation_faults
from mocapfix.bench.process_usage import ProcessUsage, run_measured
from mocapfix.read.capture import read_take
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.synthetic import SyntheticTake
from mocapfix.synthetic.motions import compose_motion
from mocapfix.synthetic.stage_takes import compose_heavily_damaged_take, compose_tenth_missing_take
from mocapfix.synthetic.synthetic_takes import draw_subject
from mocapfix.write import write_bvh

SOUND_TAKE_SEED = 5
SOUND_TAKE_S = 60.0
TENTH_MISSING_TAKE_S = 45.0
HEAVILY_DAMAGED_TAKE_S = 13.0
ANIMATION_RATE_HZ = 120.0
ANIMATION_S = 5200 / ANIMATION_RATE_HZ
ANIMATION_FAULTS = (("pop", "1 frame"), ("jitter", "short"))  # kind and duration, see inject_animation_faults
WARM_UP_SCENES = ("heavily_damaged", "animation")
WARM_UP_S = 3.0  # duration of the motion that is cleaned once, so that all kernels are compiled
SOLVER_TAKE = "noisy"  # of the common task
SOLVER_REPEATS = 5  # timings of the solver before each clean, and after the last
REPAIRED_ERROR_M = 0.02  # a displaced sample that is nearer to the truth than this afterwards is repaired
CLEAN_COMMAND = (sys.executable, "-P", "-m", "mocapfix", "clean")  # -P: not the package in the current folder

CleanCost = dict[str, float]
"""seconds, seconds_per_second, over_solver, peak_mb, cpu_seconds; if samples are displaced, moved_mended, error_mm, left_empty"""


class CleanedScene(NamedTuple):
    """A file to be cleaned.

    motion_s  duration of its motion
    truth     of a marker take; None for an animation
    """

    path: Path
    motion_s: float
    truth: SyntheticTake | None


def write_sound_take(folder: Path, seconds: float = SOUND_TAKE_S) -> CleanedScene:
    """Write a take with few gaps and spikes."""
    return _write_take(folder / "sound.c3d", synthetic.compose_take(SOUND_TAKE_SEED, seconds))


def write_tenth_missing_take(folder: Path, seconds: float = TENTH_MISSING_TAKE_S) -> CleanedScene:
    """Write a take with a tenth of its samples missing."""
    return _write_take(folder / "tenth-missing.c3d", compose_tenth_missing_take(seconds=seconds))


def write_heavily_damaged_take(folder: Path, seconds: float = HEAVILY_DAMAGED_TAKE_S) -> CleanedScene:
    """Write a take with many samples missing and displaced."""
    return _write_take(folder / "heavily-damaged.c3d", compose_heavily_damaged_take(seconds=seconds))


def write_faulty_animation(folder: Path, seconds: float = ANIMATION_S) -> CleanedScene:
    """Write a BVH with pops and jitter."""
    rng = np.random.default_rng(SOUND_TAKE_SEED)
    subject = draw_subject(rng, asymmetric=False)
    motion = compose_motion(subject, seconds, ANIMATION_RATE_HZ)
    for kind, duration_name in ANIMATION_FAULTS:
        motion, _ = inject_animation_faults(motion, subject.skeleton, ANIMATION_RATE_HZ, kind, duration_name, rng)
    path = folder / "animation.bvh"
    write_bvh(path, load_cmu31_body().skeleton, motion, ANIMATION_RATE_HZ)
    return CleanedScene(path, motion.frame_count / ANIMATION_RATE_HZ, None)


CLEAN_SCENES: dict[str, Callable[..., CleanedScene]] = {
    "sound": write_sound_take,
    "tenth_missing": write_tenth_missing_take,
    "heavily_damaged": write_heavily_damaged_take,
    "animation": write_faulty_animation,
}
"""functions of a folder and a duration in seconds"""


def measure_clean_speed(
    run_count: int, progress: ProgressCallback = lambda _: None, names: Iterable[str] = tuple(CLEAN_SCENES), warm_up: bool = True
) -> dict[str, CleanCost]:
    """Return the cost of cleaning each scene of CLEAN_SCENES: the medians of several runs.

    run_count  cleans of each scene, one round of all scenes after another
    warm_up    clean short takes first, so that no kernel is compiled while a clean is measured
    """
    names, task = tuple(names), build_common_task()
    runs: dict[str, list[CleanCost]] = {name: [] for name in names}
    with TemporaryDirectory() as folder:
        for name in WARM_UP_SCENES if warm_up else ():
            progress(f"warm-up, {name}")
            run_clean_process(CLEAN_SCENES[name](Path(folder), WARM_UP_S).path)
        scenes = {name: CLEAN_SCENES[name](Path(folder)) for name in names}
        measure_solver_rate(task)  # compiles
        solver_fps = measure_solver_rate(task)
        for run in range(run_count):
            for name, scene in scenes.items():
                progress(f"{name}, run {run + 1} of {run_count}")
                usage, scores = clean_scene(scene)
                fps_before, solver_fps = solver_fps, measure_solver_rate(task)
                solver_load = task.rate_hz / max(fps_before, solver_fps)  # processor seconds per second of motion
                runs[name].append(summarise_run(usage, scene.motion_s, solver_load) | scores)
    return {name: {key: median(each[key] for each in rows) for key in rows[0]} for name, rows in runs.items()}


def measure_solver_rate(task: CommonTask) -> float:
    """Return the frames per second of processor time of the solver on the common task: the best of several timings.

    Other programs on the machine only make it slower.
    """
    durations = [solve_with_mocapfix(task, SOLVER_TAKE, use_all_cores=False).duration_s for _ in range(SOLVER_REPEATS)]
    return len(task.takes[SOLVER_TAKE]) / min(durations)


def clean_scene(scene: CleanedScene) -> tuple[ProcessUsage, dict[str, float]]:
    """Clean a scene; return what that used, and the errors if samples of the scene are displaced."""
    with TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        usage = run_clean_process(scene.path, output)
        if scene.truth is None or not scene.truth.spike_mask.any():
            return usage, {}
        return usage, score_markers(scene.truth, read_take(output / scene.path.name).markers)


def run_clean_process(path: Path, output: Path | None = None) -> ProcessUsage:
    """Run `mocapfix clean` with this package in a process of its own, and return what it used."""
    package_parent = str(Path(mocapfix.__file__).parent.parent)
    search_path = os.pathsep.join(filter(None, (package_parent, os.environ.get("PYTHONPATH"))))
    output_arguments = ("--out", str(output)) if output else ()
    return run_measured((*CLEAN_COMMAND, str(path), *output_arguments), os.environ | {"PYTHONPATH": search_path})


def summarise_run(usage: ProcessUsage, motion_s: float, solver_load: float) -> CleanCost:
    """Return the costs of one clean.

    solver_load  processor seconds that the solver takes for a second of motion
    """
    return {
        "seconds": usage.duration_s,
        "seconds_per_second": usage.duration_s / motion_s,
        "over_solver": usage.cpu_s / motion_s / solver_load,
        "peak_mb": usage.peak_mb,
        "cpu_seconds": usage.cpu_s,
    }


def score_markers(truth: SyntheticTake, markers: np.ndarray) -> dict[str, float]:
    """Return the share of displaced samples that are now near the truth, and the mean error in mm of all samples that have a
    value, and the share of those that have none.
    """
    error_m = np.linalg.norm(markers - truth.marker_positions, axis=-1)
    return {
        "moved_mended": float((error_m[truth.spike_mask] < REPAIRED_ERROR_M).mean()),
        "error_mm": 1e3 * float(np.nanmean(error_m)),
        "left_empty": float(np.isnan(error_m).mean()),
    }


def _write_take(path: Path, truth: SyntheticTake) -> CleanedScene:
    synthetic.write_synthetic_take(path, truth)
    return CleanedScene(path, len(truth.marker_positions) / truth.rate, truth)

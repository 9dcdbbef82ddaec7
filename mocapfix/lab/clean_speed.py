"""Benchmark of whole cleans: the cost of `mocapfix clean` on composed files, relative to the solver's own rate.

Every file is cleaned as a user does it, in a process of its own. The solver is timed on the common task before and after each
clean. Costs, of the whole and of each part by its report, are compared in processor time, because other programs on the machine
change that much less than the time by the clock, and because it does not depend on the number of cores.

Two files are as damaged as captures of a stage: a tenth of the samples missing, or many missing and displaced. The duration of a
gap has a log-uniform distribution. The markers of a limb are sometimes lost together, as behind another person.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

import mocapfix
from mocapfix.io.bvh import write_bvh
from mocapfix.io.capture import read_take
from mocapfix.lab.animation_repair import inject_animation_faults
from mocapfix.lab.common_task import CommonTask, build_common_task
from mocapfix.lab.compared_solvers import solve_with_mocapfix
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.subject import Subject
from mocapfix.synthetic import SyntheticTake, compose_motion, compose_take, draw_subject, simulate_markers, write_synthetic_take

LAUNCHER = """
import json, os, subprocess, sys, time
started = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
_, status, usage = os.wait4(process.pid, 0)
process.returncode = os.waitstatus_to_exitcode(status)
unit_per_mib = 1024 * 1024 if sys.platform == "darwin" else 1024  # of ru_maxrss
figures = (time.perf_counter() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / unit_per_mib)
print(json.dumps(figures))
sys.exit(process.returncode if process.returncode >= 0 else 1)
"""
"""the program of a small process that starts a command: one that is started by a large process inherits its peak memory"""
MAX_QUOTED_OUTPUT = 2000  # characters of a failed command's output that its error quotes


class ProcessUsage(NamedTuple):
    """What a command used until it ended."""

    duration_s: float  # by the clock
    cpu_s: float  # processor time of all threads, in the program and in the system
    peak_mb: float  # largest resident memory, MiB


def run_measured(command: Sequence[str], environment: Mapping[str, str]) -> ProcessUsage:
    """Run a command without input and return what it used.

    Raises RuntimeError with the end of its output if it fails.
    """
    launcher = [sys.executable, "-I", "-S", "-c", LAUNCHER, *command]
    ran = subprocess.run(
        launcher, env=dict(environment), stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", check=False
    )
    if ran.returncode:
        raise RuntimeError(f"{' '.join(command)}: status {ran.returncode}\n{ran.stderr[-MAX_QUOTED_OUTPUT:]}")
    return ProcessUsage(*json.loads(ran.stdout))


TENTH_MISSING_SHARE = 0.1  # of the samples
STAGE_GAP_DURATION_S = (0.01, 5.0)  # of a gap of one marker
LIMB_GAP_DURATION_S = (0.1, 1.5)  # of a gap of all markers of a limb
LIMB_GAP_PROBABILITY = 0.05  # of a gap to be one of a whole limb
LIMB_JOINT_SUFFIXES = {  # ends of the names of each limb's joints, without the side
    "arm": ("Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1", "Thumb"),
    "hand": ("Hand", "FingerBase", "HandIndex1", "Thumb"),
    "leg": ("UpLeg", "Leg", "Foot", "ToeBase"),
    "foot": ("Foot", "ToeBase"),
}

HEAVY_MARKER_SET = "production57"
HEAVY_MISSING_SHARE = 0.13  # of the samples
HEAVY_GAP_FRAMES = (1, 200)
HEAVY_MOVED_SHARE = 0.06  # of the visible samples, each displaced on its own
HEAVY_MOVED_M = 0.095  # distance of a displaced sample from the truth


def compose_tenth_missing_take(seed: int = 5, seconds: float = 45.0, rate: float = 120.0) -> SyntheticTake:
    """Return a take with a tenth of its samples missing and nothing displaced; the same for the same arguments."""
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    missing = draw_stage_gaps(rng, motion.frame_count, rate, find_limb_markers(subject), TENTH_MISSING_SHARE)
    damaged, no_spikes = np.where(missing[..., None], np.nan, markers), np.zeros_like(missing)
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, no_spikes, subject.labels, rate)


def compose_heavily_damaged_take(seed: int = 11, seconds: float = 13.0, rate: float = 60.0) -> SyntheticTake:
    """Return a take of 57 markers with HEAVY_MISSING_SHARE of its samples missing and HEAVY_MOVED_SHARE of the others displaced.

    The `spike_mask` of the result has the displaced samples. The same arguments give the same take.
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True, marker_set_name=HEAVY_MARKER_SET)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    marker_count = len(subject.labels)
    missing = np.zeros((motion.frame_count, marker_count), bool)
    while missing.mean() < HEAVY_MISSING_SHARE:
        _hide_run(rng, missing, np.arange(marker_count) == rng.integers(marker_count), HEAVY_GAP_FRAMES)
    is_moved = (rng.random(missing.shape) < HEAVY_MOVED_SHARE) & ~missing
    direction = rng.normal(size=markers.shape)
    shift = HEAVY_MOVED_M * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    damaged = np.where(missing[..., None], np.nan, markers + shift * is_moved[..., None])
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, is_moved, subject.labels, rate)


def find_limb_markers(subject: Subject) -> Bool[np.ndarray, "L M"]:
    """Return which markers each limb carries: arms, hands, legs and feet on both sides."""
    joint_names = [subject.skeleton.names[j] for j in subject.joints]
    limbs = [{side + suffix for suffix in suffixes} for side in ("Left", "Right") for suffixes in LIMB_JOINT_SUFFIXES.values()]
    return np.array([[name in limb for name in joint_names] for limb in limbs])


def draw_stage_gaps(
    rng: np.random.Generator, frame_count: int, rate: float, limb_markers: Bool[np.ndarray, "L M"], share: float
) -> Bool[np.ndarray, "T M"]:
    """Return a mask of missing samples that covers this share of all samples, or little more."""
    marker_count = limb_markers.shape[1]
    missing = np.zeros((frame_count, marker_count), bool)
    while missing.mean() < share:
        is_limb_gap = rng.random() < LIMB_GAP_PROBABILITY
        markers = (
            limb_markers[rng.integers(len(limb_markers))]
            if is_limb_gap
            else np.arange(marker_count) == rng.integers(marker_count)
        )
        shortest_s, longest_s = LIMB_GAP_DURATION_S if is_limb_gap else STAGE_GAP_DURATION_S
        _hide_run(rng, missing, markers, (shortest_s * rate, longest_s * rate))
    return missing


def _hide_run(
    rng: np.random.Generator,
    missing: Bool[np.ndarray, "T M"],
    is_hidden: Bool[np.ndarray, " M"],
    range_frames: tuple[float, float],
) -> None:
    """Mark a run of frames of some markers as missing; its length is log-uniform in a range."""
    shortest, longest = range_frames
    length = max(1, int(shortest * (longest / shortest) ** rng.random()))
    first = rng.integers(len(missing))
    missing[first : first + length, is_hidden] = True


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
"""seconds, seconds_per_second, over_solver, peak_mb, cpu_seconds, and over_solver of each part, as "over_solver, fill"; if
samples are displaced, moved_mended, error_mm, left_empty"""


class CleanedScene(NamedTuple):
    """A file to be cleaned."""

    path: Path
    motion_s: float  # duration of its motion
    truth: SyntheticTake | None  # of a marker take; None for an animation


def write_sound_take(folder: Path, seconds: float = SOUND_TAKE_S) -> CleanedScene:
    """Write a take with few gaps and spikes."""
    return _write_take(folder / "sound.c3d", compose_take(SOUND_TAKE_SEED, seconds))


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

    Args:
        run_count: Cleans of each scene, one round of all scenes after another.
        warm_up: Clean short takes first, so that no kernel is compiled while a clean is measured.
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
                usage, part_s, scores = clean_scene(scene)
                fps_before, solver_fps = solver_fps, measure_solver_rate(task)
                solver_load = task.rate_hz / max(fps_before, solver_fps)  # processor seconds per second of motion
                parts = {f"over_solver, {part}": seconds / scene.motion_s / solver_load for part, seconds in part_s.items()}
                runs[name].append(summarise_run(usage, scene.motion_s, solver_load) | parts | scores)
    return {name: {key: median(each[key] for each in rows) for key in rows[0]} for name, rows in runs.items()}


def measure_solver_rate(task: CommonTask) -> float:
    """Return the frames per second of processor time of the solver on the common task: the best of several timings.

    Other programs on the machine only make it slower.
    """
    durations = [solve_with_mocapfix(task, SOLVER_TAKE, use_all_cores=False).duration_s for _ in range(SOLVER_REPEATS)]
    return len(task.takes[SOLVER_TAKE]) / min(durations)


def clean_scene(scene: CleanedScene) -> tuple[ProcessUsage, dict[str, float], dict[str, float]]:
    """Clean a scene; return what that used, processor seconds by part, and the errors if samples of the scene are displaced."""
    with TemporaryDirectory() as folder:
        output = Path(folder) / "out"
        usage = run_clean_process(scene.path, output)
        times = json.loads((output / f"{scene.path.stem}.report.json").read_bytes())["times"]
        part_s = {part: float(time["processor_seconds"]) for part, time in times.items()}
        if scene.truth is None or not scene.truth.spike_mask.any():
            return usage, part_s, {}
        return usage, part_s, score_markers(scene.truth, read_take(output / scene.path.name).markers)


def run_clean_process(path: Path, output: Path | None = None) -> ProcessUsage:
    """Run `mocapfix clean` with this package in a process of its own, and return what it used."""
    package_parent = str(Path(mocapfix.__file__).parent.parent)
    search_path = os.pathsep.join(filter(None, (package_parent, os.environ.get("PYTHONPATH"))))
    output_arguments = ("--out", str(output)) if output else ()
    return run_measured((*CLEAN_COMMAND, str(path), *output_arguments), os.environ | {"PYTHONPATH": search_path})


def summarise_run(usage: ProcessUsage, motion_s: float, solver_load: float) -> CleanCost:
    """Return the costs of one clean.

    Args:
        solver_load: Processor seconds that the solver takes for a second of motion.
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
    write_synthetic_take(path, truth)
    return CleanedScene(path, len(truth.marker_positions) / truth.rate, truth)

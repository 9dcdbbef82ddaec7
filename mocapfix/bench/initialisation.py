"""Benchmarks of HybrIK's closed form: the papers' tables on unseen subjects, its speed, and initial poses for the solver.

If the truth is known, it is compared as the start `truth`: a frame that is wrong from there as well is not the fault of a start.
The first solve is that of each frame from its start (`previous` starts each frame from the previous one); the full solve is that
of `mocapfix clean --prior none`. The module initialisation_outcomes defines wrong frames, initialisation_takes the takes.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from mocapfix.bench.common_task import build_known_motion
from mocapfix.bench.given_joints import time_rounds
from mocapfix.bench.hybrik_tables import (
    NO_TWISTS,
    build_cmu41_subject,
    compute_noise_ratios,
    measure_joint_noise,
    measure_twist_sources,
)
from mocapfix.bench.initialisation_outcomes import (
    StartMethod,
    StartOutcome,
    evaluate_start,
    find_observed_joints,
    find_wrong_frames,
)
from mocapfix.bench.initialisation_takes import (
    MARKER_LOSSES,
    InitialisationTake,
    add_ghosts,
    compose_initialisation_takes,
    damage_takes,
    perform_test_recordings,
    read_captures,
)
from mocapfix.bench.sound_takes import load_unseen_poses, sample_subject_poses
from mocapfix.files.option_choices import INIT_METHODS
from mocapfix.initialise import initial_motion
from mocapfix.initialise.hybrik import HybrikVariant, solve_hybrik
from mocapfix.kernels.precompilation import count_cores
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

TRUTH_START = "truth"
INITIALISATION_SEEDS = range(8)  # subjects that no constant was tuned on
TIMING_REPEATS = 3  # the median counts
DAMAGED_TAKE_STRIDE = 4  # every fourth performance is also damaged, because lost limbs take long to reconstruct


class TakeOutcome(NamedTuple):
    """The outcome of a start of a take, and its wrong frames (T,) after the first and the full solve.

    is_wrong_from_start  frames that are wrong after the full solve, but not if started from the truth
    """

    case: InitialisationTake
    outcome: StartOutcome
    is_wrong_first_solve: np.ndarray
    is_wrong: np.ndarray
    is_wrong_from_start: np.ndarray


def measure_initialisation(
    methods: Sequence[str] = INIT_METHODS,
    motion_folder: Path | None = None,
    capture_folder: Path | None = None,
    seeds: Iterable[int] = INITIALISATION_SEEDS,
    repeats: int = TIMING_REPEATS,
    progress: ProgressCallback = lambda _: None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the results by set of takes and by start, see `summarise_outcomes`.

    methods         names of starts, of INIT_METHODS
    motion_folder   holds test.npz, motion of subjects that no model was trained on, and skeletons.json
    capture_folder  holds C3D files, whose truth is not known
    seeds           of the composed takes
    repeats         how often each take is timed

    Raises ReadError if a folder does not hold the required files.
    """
    starts: dict[str, StartMethod] = {name: partial(start_from_markers, method=name) for name in methods}
    results: dict[str, dict[str, dict[str, Any]]] = {}
    for name, cases in build_take_sets(motion_folder, capture_folder, seeds).items():

        def report_take(take_name: str, name: str = name) -> None:
            progress(f"{name}: {take_name}")

        results[name] = compare_starts(cases, starts, repeats, report_take)
    return results


def start_from_markers(case: InitialisationTake, method: str) -> Motion:
    """Return the start of a take by one of INIT_METHODS."""
    body = load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    return initial_motion.initialise_motion(case.take, case.subject, body, prior, method)


def build_truth_start(case: InitialisationTake) -> dict[str, StartMethod]:
    """Return the start from the truth by its name, or nothing if the truth is not known."""
    motion = case.true_motion
    return {} if motion is None else {TRUTH_START: lambda _: motion}


def build_take_sets(
    motion_folder: Path | None, capture_folder: Path | None, seeds: Iterable[int]
) -> dict[str, Iterable[InitialisationTake]]:
    """Return the takes of each set, with the arguments of `measure_initialisation`."""
    sets: dict[str, Iterable[InitialisationTake]] = {"composed": compose_initialisation_takes(seeds)}
    if motion_folder is not None:
        performed = list(perform_test_recordings(motion_folder))
        sets["performed"] = performed
        damaged = performed[::DAMAGED_TAKE_STRIDE]
        sets |= {f"performed, {name}": damage_takes(damaged, draw_losses) for name, draw_losses in MARKER_LOSSES.items()}
        sets["performed, a ghost"] = add_ghosts(damaged)
    if capture_folder is not None:
        sets["captures"] = read_captures(capture_folder)
    return sets


def compare_starts(
    cases: Iterable[InitialisationTake],
    methods: dict[str, StartMethod],
    repeats: int = TIMING_REPEATS,
    progress: ProgressCallback = lambda _: None,
) -> dict[str, dict[str, Any]]:
    """Return the summary of all takes by start; also that of the truth, if it is known."""
    outcomes: dict[str, list[TakeOutcome]] = {}
    for case in cases:
        progress(case.name)
        starts = build_truth_start(case) | methods
        by_start = {name: evaluate_start(case, method, repeats) for name, method in starts.items()}
        wrong_first = find_wrong_frames(case, {name: each.first_solve for name, each in by_start.items()})
        wrong = find_wrong_frames(case, {name: each.full_solve for name, each in by_start.items()})
        wrong_from_truth = wrong.get(TRUTH_START, np.zeros(case.take.frame_count, bool))
        for name, each in by_start.items():
            outcome = TakeOutcome(case, each, wrong_first[name], wrong[name], wrong[name] & ~wrong_from_truth)
            outcomes.setdefault(name, []).append(outcome)
    return {name: summarise_outcomes(each) for name, each in outcomes.items()}


def summarise_outcomes(outcomes: list[TakeOutcome]) -> dict[str, Any]:
    """Return the sums and means over all takes.

    frames, wrong, wrong_from_start, wrong_first_solve, unconverged  numbers of frames, see TakeOutcome and StartOutcome
    iterations, iterations_first_solve                               mean per frame
    start_markers_mm   mean distance of the start from the visible markers
    start_joints_mm    mean distance of observed joints from the true ones; None if these are not known
    start_seconds      duration of the start; seconds: of start and solve
    wrong_in           number of wrong frames by take, if any
    """
    starts = [each.outcome for each in outcomes]
    return {
        "frames": sum(each.case.take.frame_count for each in outcomes),
        "wrong": int(sum(each.is_wrong.sum() for each in outcomes)),
        "wrong_from_start": int(sum(each.is_wrong_from_start.sum() for each in outcomes)),
        "wrong_first_solve": int(sum(each.is_wrong_first_solve.sum() for each in outcomes)),
        "unconverged": int(sum(each.is_unconverged.sum() for each in starts)),
        "iterations": float(np.concatenate([each.full_solve.iterations for each in starts]).mean()),
        "iterations_first_solve": float(np.concatenate([each.first_solve.iterations for each in starts]).mean()),
        "start_markers_mm": 1e3 * float(np.nanmean(np.concatenate([each.marker_error_m for each in starts]))),
        "start_joints_mm": compute_start_joint_error_mm(outcomes),
        "start_seconds": sum(each.durations_s[0] for each in starts),
        "seconds": sum(each.durations_s[1] for each in starts),
        "wrong_in": {each.case.name: int(each.is_wrong.sum()) for each in outcomes if each.is_wrong.any()},
    }


def compute_start_joint_error_mm(outcomes: list[TakeOutcome]) -> float | None:
    """Return the mean distance in mm of observed joints at the start from the true ones, or None if these are not known."""
    errors = [
        np.linalg.norm(each.outcome.start_joint_positions - each.case.true_joint_positions, axis=-1)[
            find_observed_joints(each.case)
        ]
        for each in outcomes
        if each.case.true_joint_positions is not None
    ]
    return 1e3 * float(np.concatenate(errors).mean()) if errors else None


MAX_HYBRIK_POSES = 10_000  # of a motion folder
SPEED_FRAME_COUNT = 60_000  # frames of which the speed is measured
HYBRIK_SPEED_ROUNDS = 5  # the median counts
POSES_TAKE_RATE_HZ = 120.0  # of a take that consists of independent poses


def measure_hybrik(motion_folder: Path | None, capture_folder: Path | None, progress: ProgressCallback) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON.

    motion_folder   CMU motion whose test subjects give the poses and, in its test.npz, takes for the starts; None for the shipped
                    poses
    capture_folder  C3D files, also for the starts

    Raises ReadError if a folder does not hold the required files.
    """
    progress("reading")
    poses = sample_subject_poses(motion_folder, MAX_HYBRIK_POSES) if motion_folder else load_unseen_poses()
    subject = build_cmu41_subject()
    noise_results = measure_joint_noise(poses, progress)
    results: dict[str, Any] = {"poses": len(poses), "threads": count_cores()} | noise_results
    results["ratios"] = {key: compute_noise_ratios(noise_results[key]) for key in ("jitter_mm", "wrong_bones_mm")}
    results["twist"] = measure_twist_sources(poses, subject, progress)
    progress("frames per second")
    results |= measure_hybrik_speeds(poses, subject)
    results["starts"] = measure_initialisation(motion_folder=motion_folder, capture_folder=capture_folder, progress=progress)
    return results


def measure_hybrik_speeds(poses: Float[np.ndarray, "N J 3 3"], subject: Subject) -> dict[str, Any]:
    """Return the frames per second on all cores for repeated poses in memory.

    fps               variant X from joint positions, with regressed twists
    fps_by_way        the closed form of each variant only, with given twists
    from_markers_fps  variant X from markers, whose joint positions are estimated first
    """
    rotations = np.tile(poses, (-(-SPEED_FRAME_COUNT // len(poses)), 1, 1, 1))
    frame_count = len(rotations)
    motion = build_known_motion(np.zeros((frame_count, 3)), rotations)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    take, body = Take(markers, subject.labels, POSES_TAKE_RATE_HZ), load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)

    def measure_variant(variant: HybrikVariant) -> float:
        return compute_frames_per_second(frame_count, lambda: solve_hybrik(joints, subject, variant=variant, twists=NO_TWISTS))

    return {
        "fps": compute_frames_per_second(frame_count, lambda: solve_hybrik(joints, subject)),
        "fps_by_way": {variant: measure_variant(variant) for variant in get_args(HybrikVariant)},
        "from_markers_fps": compute_frames_per_second(
            frame_count, lambda: initial_motion.initialise_motion(take, subject, body, prior, method="hybrik-x")
        ),
    }


def compute_frames_per_second(frame_count: int, call: Callable[[], object]) -> float:
    """Return the frames per second by the median of several rounds."""
    return frame_count / median(time_rounds(call, HYBRIK_SPEED_ROUNDS))

"""Starts of the solve compared: where they lie, how many iterations they cost, and in which frames the solve ends wrong.

Where the truth is known, it is a start like any other, `truth`: what ends wrong from there, too, is no start's fault.
`alone` is the first solve, of each frame from its start (`previous` starts where the frame before ended); what has no such word
is the whole solve, as `mocapfix clean --prior none` does it. What is wrong, see start_ends; on which takes, see start_takes.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.bench import initialisation_takes
from mocapfix.bench.initialisation_outcomes import (
    StartMethod,
    StartOutcome,
    evaluate_start,
    find_observed_joints,
    find_wrong_frames,
)
from mocapfix.bench.initialisation_takes import InitialisationTake
from mocapfix.initialise import initial_motion
from mocapfix.motion import Motion
from mocapfix.options import INIT_METHODS
from mocapfix.pose_prior import mean_pose
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body

TRUTH_START = "truth"
INITIALISATION_SEEDS = range(8)  # people on whom no constant was set
TIMING_REPEATS = 3  # of which the median is the time
DAMAGED_TAKE_STRIDE = 4  # one performance of so many is also damaged, for limbs that are lost take long to put back


class TakeOutcome(NamedTuple):
    """What became of a take, and which of its frames (T,) ended wrong, after the first solve and after all of it; and which of
    the latter ends right from the truth.
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
) -> dict[str, dict[str, dict]]:
    """-> set of takes -> way -> `row`.

    ways      names of starts, out of scenes.STARTS
    data      a folder with test.npz, motion of people whom no model has seen, and skeletons.json
    captures  a folder of C3D files, of which the truth is not known
    seeds     of the composed takes
    repeats   how often each take is timed

    Raises ReadError where a folder does not hold what it should.
    """
    starts: dict[str, StartMethod] = {name: partial(start_from_markers, method=name) for name in methods}
    said = {}
    for name, cases in build_take_sets(motion_folder, capture_folder, seeds).items():
        said[name] = compare_starts(cases, starts, repeats, lambda take, name=name: progress(f"{name}: {take}"))
    return said


def start_from_markers(case: InitialisationTake, method: str) -> Motion:
    """-> the start of a take that mocapfix has under this name."""
    body = load_cmu31_body()
    return initial_motion.initialise_motion(
        case.take, case.subject, body, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton), method
    )


def build_truth_start(case: InitialisationTake) -> dict[str, StartMethod]:
    """-> the start from the truth, by its name; none where nobody knows it."""
    motion = case.true_motion
    return {} if motion is None else {TRUTH_START: lambda _: motion}


def build_take_sets(
    motion_folder: Path | None, capture_folder: Path | None, seeds: Iterable[int]
) -> dict[str, Iterable[InitialisationTake]]:
    """-> the takes of each set, as `run` is told."""
    found: dict[str, Iterable[InitialisationTake]] = {"composed": initialisation_takes.compose_initialisation_takes(seeds)}
    if motion_folder is not None:
        whole = list(initialisation_takes.perform_test_recordings(motion_folder))
        found["performed"] = whole
        found |= {
            f"performed, {name}": initialisation_takes.damage_takes(whole[::DAMAGED_TAKE_STRIDE], lost)
            for name, lost in initialisation_takes.MARKER_LOSSES.items()
        }
        found["performed, a ghost"] = initialisation_takes.add_ghosts(whole[::DAMAGED_TAKE_STRIDE])
    if capture_folder is not None:
        found["captures"] = initialisation_takes.read_captures(capture_folder)
    return found


def compare_starts(
    cases: Iterable[InitialisationTake],
    methods: dict[str, StartMethod],
    repeats: int = TIMING_REPEATS,
    progress: ProgressCallback = lambda _: None,
) -> dict[str, dict]:
    """-> way -> the `row` of all takes; also from the truth, where that is known."""
    outcomes: dict[str, list[TakeOutcome]] = {}
    for case in cases:
        progress(case.name)
        came = {name: evaluate_start(case, way, repeats) for name, way in (build_truth_start(case) | methods).items()}
        alone = find_wrong_frames(case, {name: each.first_solve for name, each in came.items()})
        whole = find_wrong_frames(case, {name: each.full_solve for name, each in came.items()})
        best = whole.get(TRUTH_START, np.zeros(case.take.frame_count, bool))
        for name, each in came.items():
            outcomes.setdefault(name, []).append(TakeOutcome(case, each, alone[name], whole[name], whole[name] & ~best))
    return {name: summarise_outcomes(each) for name, each in outcomes.items()}


def summarise_outcomes(outcomes: list[TakeOutcome]) -> dict:
    """-> over all takes: `frames`, how many end `wrong`, are `astray` (wrong, and right from the truth), end `wrong_alone` or are
    `unconverged`; `iterations` and `iterations_alone` of a frame on average; where frames start, `start_markers_mm` from those
    seen on average and `start_joints_mm` from the true ones that markers tell of (None where nobody knows them);
    `start_seconds` and `seconds`, of the start alone and with the solve; `wrong_in`, the takes with frames that end wrong, and
    how many.
    """
    came = [each.outcome for each in outcomes]
    return {
        "frames": sum(each.case.take.frame_count for each in outcomes),
        "wrong": int(sum(each.is_wrong.sum() for each in outcomes)),
        "astray": int(sum(each.is_wrong_from_start.sum() for each in outcomes)),
        "wrong_alone": int(sum(each.is_wrong_first_solve.sum() for each in outcomes)),
        "unconverged": int(sum(each.is_unconverged.sum() for each in came)),
        "iterations": float(np.concatenate([each.full_solve.iterations for each in came]).mean()),
        "iterations_alone": float(np.concatenate([each.first_solve.iterations for each in came]).mean()),
        "start_markers_mm": 1e3 * float(np.nanmean(np.concatenate([each.marker_error_m for each in came]))),
        "start_joints_mm": compute_start_joint_error_mm(outcomes),
        "start_seconds": sum(each.durations_s[0] for each in came),
        "seconds": sum(each.durations_s[1] for each in came),
        "wrong_in": {each.case.name: int(each.is_wrong.sum()) for each in outcomes if each.is_wrong.any()},
    }


def compute_start_joint_error_mm(outcomes: list[TakeOutcome]) -> float | None:
    """-> mm: how far from the truth frames start, on average over the joints that markers tell of."""
    known = [(each.case, each.outcome.start_joint_positions) for each in outcomes if each.case.true_joint_positions is not None]
    if not known:
        return None
    return 1e3 * float(
        np.concatenate(
            [np.linalg.norm(at - case.true_joint_positions, axis=-1)[find_observed_joints(case)] for case, at in known]
        ).mean()
    )

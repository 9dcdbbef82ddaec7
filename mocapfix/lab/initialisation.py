"""Benchmarks of HybrIK's closed form: the papers' tables on unseen subjects, its speed, and initial poses for the solver.

If the truth is known, it is compared as the start `truth`: a frame that is wrong from there as well is not the fault of a start.
The first solve is that of each frame from its start (`previous` starts each frame from the previous one); the full solve is that
of `mocapfix clean --prior none`, on the calibrated body.

A frame is wrong if an observed joint is further than WRONG_JOINT_DISTANCE_M from the truth. A joint is observed if three markers
on the segments that meet there are visible, or all of them if there are fewer. If the truth is not known, as in captures, the
pose of least cost among all compared starts replaces it, and a frame of hardly greater cost is not wrong, whatever its pose.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.detect.loop import detect_sample_faults
from mocapfix.errors import ReadError
from mocapfix.io import capture
from mocapfix.lab import hybrik_tables
from mocapfix.lab.hands import measure_finger_noise
from mocapfix.lab.pose_priors import time_rounds
from mocapfix.lab.sound_takes import (
    PerformedMotion,
    build_known_motion,
    find_informative_markers,
    load_unseen_poses,
    read_performed_motions,
    sample_subject_poses,
    solve_motion,
)
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.subject import Subject
from mocapfix.model.system import count_cores
from mocapfix.model.take import Take
from mocapfix.options import INIT_METHODS, SolveOptions, SubjectOptions
from mocapfix.solve import initial_motion, kinematics
from mocapfix.solve.hybrik import HybrikVariant, solve_hybrik
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import load_joint_limits, load_mean_pose_prior
from mocapfix.solve.pose_problem import PoseProblem, build_pose_problem
from mocapfix.subject import calibration
from mocapfix.subject.library import load_marker_set, resolve_subject
from mocapfix.synthetic import compose_take, draw_subject, simulate_markers

SINGLE_GAP_SHARE = 0.1  # fraction of the samples that is missing in gaps of single markers
MIN_SINGLE_GAP_S = 0.1
MAX_SINGLE_GAP_S = 2.0
GROUP_LOSS_INTERVAL_S = 1.0  # interval between losses of several markers
GROUP_LOSS_DURATION_S = 0.5
LOST_MARKER_SHARE = 0.5  # fraction of the markers that is lost at the same time
GHOST_SD_M = 0.4  # per axis: distance of a ghost


class InitialisationTake(NamedTuple):
    """A take of the body's K markers and the calibrated body; and if known, the true joint positions (T, J, 3) and motion.

    The true motion is that of a slightly different body.
    """

    name: str
    take: Take
    subject: Subject
    true_joint_positions: np.ndarray | None
    true_motion: Motion | None


MarkerLoss = Callable[[InitialisationTake, np.random.Generator], Bool[np.ndarray, "T K"]]


def compose_initialisation_takes(seeds: Iterable[int]) -> Iterator[InitialisationTake]:
    """Yield composed takes with gaps, without the samples of spikes."""
    for seed in seeds:
        truth = compose_take(seed, asymmetric=True)
        markers = np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions)
        take = Take(markers, truth.labels, truth.rate)
        subject = calibrate_take(take, load_marker_set("cmu41"))
        yield InitialisationTake(f"seed {seed}", take, subject, truth.joint_positions, truth.motion)


def perform_test_recordings(motion_folder: Path) -> Iterator[InitialisationTake]:
    """Yield the undamaged recordings of the test subjects in the CMU marker set, calibrated on all recordings of each subject.

    Raises:
        ReadError: If the folder has no test.npz of motion.
    """
    recordings = groupby(read_performed_motions(motion_folder / "test.npz"), lambda each: each.name.split("_")[0])
    for number, (_, performances) in enumerate(recordings):
        yield from perform_subject_recordings(list(performances), np.random.default_rng(number))


def perform_subject_recordings(performances: list[PerformedMotion], rng: np.random.Generator) -> Iterator[InitialisationTake]:
    """Yield the performances of one subject with a random body."""
    body = draw_subject(rng, asymmetric=True)
    simulated = [simulate_markers(rng, body, each.motion, each.rate_hz) for each in performances]
    all_markers = np.concatenate([markers for _, markers in simulated])
    calibrated = calibrate_take(Take(all_markers, body.labels, performances[0].rate_hz), load_marker_set("cmu41"))
    for performance, (joint_positions, markers) in zip(performances, simulated, strict=True):
        take = Take(markers, body.labels, performance.rate_hz)
        yield InitialisationTake(performance.name, take, calibrated, joint_positions, performance.motion)


def damage_takes(cases: Iterable[InitialisationTake], draw_losses: MarkerLoss) -> Iterator[InitialisationTake]:
    """Yield takes without the samples that `draw_losses` returns."""
    for number, case in enumerate(cases):
        is_lost = draw_losses(case, np.random.default_rng(number))
        yield case._replace(take=case.take.replace_markers(np.where(is_lost[..., None], np.nan, case.take.markers)))


def draw_single_gaps(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return gaps of single markers of log-uniform duration."""
    is_lost, rate = np.zeros_like(case.take.visible), case.take.rate
    while is_lost.mean() < SINGLE_GAP_SHARE:
        length = round(rate * MIN_SINGLE_GAP_S * (MAX_SINGLE_GAP_S / MIN_SINGLE_GAP_S) ** rng.random())
        first = rng.integers(1 - length, len(is_lost))
        is_lost[max(0, first) : first + length, rng.integers(is_lost.shape[1])] = True
    return is_lost


def draw_segment_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of all markers of a segment, each time another one."""
    return draw_group_losses(case, lambda: case.subject.joints == rng.choice(np.unique(case.subject.joints)))


def draw_pelvis_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of all markers of the pelvis."""
    return draw_group_losses(case, lambda: case.subject.joints == 0)


def draw_half_losses(case: InitialisationTake, rng: np.random.Generator) -> Bool[np.ndarray, "T K"]:
    """Return repeated losses of half of the markers, each time others."""
    return draw_group_losses(case, lambda: rng.random(len(case.subject.joints)) < LOST_MARKER_SHARE)


def add_ghosts(cases: Iterable[InitialisationTake]) -> Iterator[InitialisationTake]:
    """Yield takes in which the label of one marker jumps to a ghost repeatedly, each time another marker."""
    for number, case in enumerate(cases):
        rng, marker_index = np.random.default_rng(number), np.arange(len(case.subject.joints))

        def choose_marker(rng: np.random.Generator = rng, marker_index: np.ndarray = marker_index) -> np.ndarray:
            return marker_index == rng.integers(len(marker_index))

        is_ghost = draw_group_losses(case, choose_marker)
        displacement = rng.normal(0, GHOST_SD_M, (len(marker_index), 3))
        yield case._replace(take=case.take.replace_markers(case.take.markers + is_ghost[..., None] * displacement))


def draw_group_losses(case: InitialisationTake, choose_markers: Callable[[], Bool[np.ndarray, " K"]]) -> Bool[np.ndarray, "T K"]:
    """Return a loss of some markers in the middle of each interval of GROUP_LOSS_INTERVAL_S."""
    is_lost, rate = np.zeros_like(case.take.visible), case.take.rate
    first_s, duration_s = (GROUP_LOSS_INTERVAL_S - GROUP_LOSS_DURATION_S) / 2, case.take.frame_count / rate
    for begin_s in np.arange(first_s, duration_s, GROUP_LOSS_INTERVAL_S):
        is_lost[round(begin_s * rate) : round((begin_s + GROUP_LOSS_DURATION_S) * rate), choose_markers()] = True
    return is_lost


MARKER_LOSSES: dict[str, MarkerLoss] = {
    "gaps": draw_single_gaps,
    "a segment lost": draw_segment_losses,
    "the pelvis lost": draw_pelvis_losses,
    "half lost": draw_half_losses,
}


def read_captures(folder: Path) -> Iterator[InitialisationTake]:
    """Yield the captures in a folder that have a known marker set. Raises ReadError if there is none."""
    is_empty = True
    for path in sorted(folder.glob("*.c3d")):
        take = capture.read_take(path)
        marker_set = resolve_subject(take, SubjectOptions()).marker_set
        if marker_set is not None:
            is_empty = False
            solver_mask = detect_sample_faults(take).compute_solver_mask(take)
            subject_take = take.select(marker_set.find_columns(take.labels), solver_mask)
            yield InitialisationTake(path.stem, subject_take, calibrate_take(subject_take, marker_set), None, None)
    if is_empty:
        raise ReadError(f"{folder}: holds no capture (.c3d) with a known marker set.")


def calibrate_take(take: Take, marker_set: MarkerSet) -> Subject:
    """Return the body that calibration estimates from a take."""
    body = load_cmu31_body()
    return calibration.fit_calibration(take, marker_set, body, load_mean_pose_prior("mean-pose", body.skeleton)).subject


StartMethod = Callable[[InitialisationTake], Motion]
WRONG_JOINT_DISTANCE_M = 0.1
MAX_EQUAL_COST_DIFFERENCE = 1.0  # costs (half a sum of squares in standard deviations) that differ less are equal
MIN_MARKERS_PER_JOINT = 3  # visible markers of an observed joint


class SolveEnd(NamedTuple):
    """The poses that a solve reached."""

    joint_positions: np.ndarray  # (T, J, 3) metres
    cost: np.ndarray  # (T,)
    iterations: np.ndarray  # (T,)


class StartOutcome(NamedTuple):
    """The outcome of one start of a take."""

    marker_error_m: np.ndarray  # (T,) mean distance of the visible markers from the body at the start, NaN if none is visible
    start_joint_positions: np.ndarray  # (T, J, 3) metres
    first_solve: SolveEnd  # end of the first solve, of each frame from its start
    full_solve: SolveEnd  # end of the whole solve
    is_unconverged: np.ndarray  # (T,) whether the first solve reached the iteration limit at the last robust scale
    durations_s: tuple[float, float]  # of the start, and of start and solve


def evaluate_start(case: InitialisationTake, method: StartMethod, repeats: int) -> StartOutcome:
    """Return the outcome of a start; durations are medians, of which three repeats exclude compilation."""
    body, options = load_cmu31_body(), SolveOptions()
    prior, limits = load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)

    def start_and_solve() -> tuple[Motion, Motion, tuple[float, float]]:
        began = perf_counter()
        start = method(case)
        started = perf_counter()
        motion = solve_motion(case.take, case.subject, body, prior, limits, start, options)
        return start, motion, (started - began, perf_counter() - began)

    runs = [start_and_solve() for _ in range(repeats)]
    start, motion, _ = runs[0]
    start_s, total_s = (median(durations[i] for _, _, durations in runs) for i in range(2))
    problem = build_pose_problem(case.take, case.subject, body, prior, limits, options)
    solution = problem.minimise((start.root_position, start.local_rotations), options.robust_scales_m)
    joint_positions, markers = kinematics.compute_joint_and_marker_positions(case.subject, start)
    return StartOutcome(
        marker_error_m=compute_marker_error(markers, case.take),
        start_joint_positions=joint_positions,
        first_solve=evaluate_solve(problem, solution.poses, solution.iterations),
        full_solve=evaluate_solve(problem, (motion.root_position, motion.local_rotations), motion.iterations),
        is_unconverged=solution.status == FrameStatus.ITERATION_LIMIT,
        durations_s=(start_s, total_s),
    )


def compute_marker_error(markers: Float[np.ndarray, "T K 3"], take: Take) -> Float[np.ndarray, " T"]:
    """Return the mean distance in metres of markers from the visible ones, NaN if none is visible."""
    distance, visible = np.linalg.norm(markers - take.markers, axis=-1), take.visible
    return np.where(visible, distance, 0.0).sum(1) / np.where(visible.any(1), visible.sum(1), np.nan)


def evaluate_solve(problem: PoseProblem, poses: Poses, iterations: Int[np.ndarray, " T"]) -> SolveEnd:
    """Return joint positions and costs of solved poses, each frame without its neighbours."""
    joint_positions, _ = kinematics.compute_tree_poses(problem.tree, *poses)
    return SolveEnd(joint_positions, problem.compute_costs(poses, SolveOptions().robust_scales_m[-1]), iterations)


def find_wrong_frames(case: InitialisationTake, ends: dict[str, SolveEnd]) -> dict[str, Bool[np.ndarray, " T"]]:
    """Return the wrong frames by start."""
    is_observed, costs = find_observed_joints(case), np.stack([end.cost for end in ends.values()])
    true_positions = case.true_joint_positions
    if true_positions is not None:
        return {name: has_distant_joint(end.joint_positions, true_positions, is_observed) for name, end in ends.items()}
    joint_positions, cheapest = np.stack([end.joint_positions for end in ends.values()]), costs.argmin(0)
    best_positions = joint_positions[cheapest, np.arange(len(cheapest))]
    max_cost = costs.min(0) + MAX_EQUAL_COST_DIFFERENCE
    return {
        name: has_distant_joint(end.joint_positions, best_positions, is_observed) & (end.cost > max_cost)
        for name, end in ends.items()
    }


def has_distant_joint(
    joint_positions: Float[np.ndarray, "T J 3"], true_positions: Float[np.ndarray, "T J 3"], is_observed: Bool[np.ndarray, "T J"]
) -> Bool[np.ndarray, " T"]:
    """Return whether any observed joint is further than WRONG_JOINT_DISTANCE_M from its true position."""
    is_distant = np.linalg.norm(joint_positions - true_positions, axis=-1) > WRONG_JOINT_DISTANCE_M
    return (is_distant & is_observed).any(axis=1)


def find_observed_joints(case: InitialisationTake) -> Bool[np.ndarray, "T J"]:
    """Return the joints that enough visible markers observe."""
    is_informative = find_informative_markers(case.subject)
    return case.take.visible.astype(int) @ is_informative.T >= np.minimum(is_informative.sum(1), MIN_MARKERS_PER_JOINT)


TRUTH_START = "truth"
INITIALISATION_SEEDS = range(8)  # subjects that no constant was tuned on
TIMING_REPEATS = 3  # the median counts
DAMAGED_TAKE_STRIDE = 4  # every fourth performance is also damaged, because lost limbs take long to reconstruct


class TakeOutcome(NamedTuple):
    """The outcome of a start of a take, and its wrong frames (T,) after the first and the full solve."""

    case: InitialisationTake
    outcome: StartOutcome
    is_wrong_first_solve: np.ndarray
    is_wrong: np.ndarray
    is_wrong_from_start: np.ndarray  # frames that are wrong after the full solve, but not if started from the truth


def measure_initialisation(
    methods: Sequence[str] = INIT_METHODS,
    motion_folder: Path | None = None,
    capture_folder: Path | None = None,
    seeds: Iterable[int] = INITIALISATION_SEEDS,
    repeats: int = TIMING_REPEATS,
    progress: ProgressCallback = lambda _: None,
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the results by set of takes and by start, see `summarise_outcomes`.

    Args:
        methods: Names of starts, of INIT_METHODS.
        motion_folder: Holds test.npz, motion of subjects that no model was trained on, and skeletons.json.
        capture_folder: Holds C3D files, whose truth is not known.

    Raises:
        ReadError: If a folder does not hold the required files.
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

    - `frames`, `wrong`, `wrong_from_start`, `wrong_first_solve`, `unconverged`: numbers of frames, see TakeOutcome and
      StartOutcome
    - `iterations`, `iterations_first_solve`: mean per frame
    - `start_markers_mm`: mean distance of the start from the visible markers
    - `start_joints_mm`: mean distance of observed joints from the true ones; None if these are not known
    - `start_seconds`: duration of the start; seconds: of start and solve
    - `wrong_in`: number of wrong frames by take, if any
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

    Args:
        motion_folder: CMU motion whose test subjects give the poses and, in its test.npz, takes for the starts; None for the
            shipped poses.
        capture_folder: C3D files, also for the starts.

    Raises:
        ReadError: If a folder does not hold the required files.
    """
    progress("reading")
    poses = sample_subject_poses(motion_folder, MAX_HYBRIK_POSES) if motion_folder else load_unseen_poses()
    subject = hybrik_tables.build_cmu41_subject()
    noise_results = hybrik_tables.measure_joint_noise(poses, progress)
    results: dict[str, Any] = {"poses": len(poses), "threads": count_cores()} | noise_results
    results["ratios"] = {key: hybrik_tables.compute_noise_ratios(noise_results[key]) for key in ("jitter_mm", "wrong_bones_mm")}
    results["fingers_mm"] = measure_finger_noise(progress)
    results["twist"] = hybrik_tables.measure_twist_sources(poses, subject, progress)
    progress("frames per second")
    results |= measure_hybrik_speeds(poses, subject)
    results["starts"] = measure_initialisation(motion_folder=motion_folder, capture_folder=capture_folder, progress=progress)
    return results


def measure_hybrik_speeds(poses: Float[np.ndarray, "N J 3 3"], subject: Subject) -> dict[str, Any]:
    """Return the frames per second on all cores for repeated poses in memory.

    - `fps`: variant X from joint positions, with regressed twists
    - `fps_by_way`: the closed form of each variant only, with given twists
    - `from_markers_fps`: variant X from markers, whose joint positions are estimated first
    """
    rotations = np.tile(poses, (-(-SPEED_FRAME_COUNT // len(poses)), 1, 1, 1))
    frame_count = len(rotations)
    motion = build_known_motion(np.zeros((frame_count, 3)), rotations)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    take, body = Take(markers, subject.labels, POSES_TAKE_RATE_HZ), load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)

    def measure_variant(variant: HybrikVariant) -> float:
        return compute_frames_per_second(
            frame_count, lambda: solve_hybrik(joints, subject, variant=variant, twists=hybrik_tables.NO_TWISTS)
        )

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

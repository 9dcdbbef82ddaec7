"""Benchmark of learned inverse kinematics (Learnable SMPLify): one step, whole takes, other methods' poses refined, and speed.

Motion is that of people that no training has read, on the average body; errors are those of 31 joints after forward kinematics.
All times are processor times of one thread, which other programs hardly change.

The baseline of Learnable SMPLify: SMPLify's optimisation with Adam, joints and a pose prior, a fixed number of iterations.

As in the paper's baseline, the pose starts at the given start and the root at the given position. There is no image and no mesh:
the cost is the squared distance of the joints, and a weak pull of the rotations towards the start.
"""

import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.errors import ReadError
from mocapfix.lab.compared_priors import JointTask, solve_joint_task
from mocapfix.lab.frame_pairs import FrameSequences, IkBatch, build_sequences
from mocapfix.lab.graph_ik import TreeLevels, compute_rotation_exponential, compute_world_tensors
from mocapfix.lab.hybrik_tables import build_cmu41_subject
from mocapfix.lab.learned_ik_training import KNOWN_JOINT_SD_M, SCORED_OFFSETS, SCORED_SD_M, build_scored_pairs, find_lost_joints
from mocapfix.lab.recordings import TRAINING_RATE_HZ, fold_clavicles, read_shard_recordings
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.solve.hybrik import solve_hybrik
from mocapfix.solve.kinematics import Poses, build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import IkNetwork, PoseRegressor, load_shipped_ik_network, smooth_positions
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.trained_priors import load_pose_model

SMPLIFY_ITERATIONS = 100
SMPLIFY_LEARNING_RATE = 0.03
"""A compromise: on held-out people 0.01, 0.03 and 0.1 leave 0.5, 0.6 and 2.0 mm one frame from the start, and 10.0, 4.5 and
3.3 mm nine frames from it."""
SMPLIFY_PRIOR_WEIGHT = 1e-5  # m^2/rad^2: weight of the rotations' change beside the joints' squared distances


def optimise_poses(
    skeleton: Skeleton, start: Poses, positions: Float[np.ndarray, "T J 3"], learning_rate: float = SMPLIFY_LEARNING_RATE
) -> Poses:
    """Return the poses after SMPLIFY_ITERATIONS of Adam from a start, given all joint positions in metres.

    Each frame is optimised on its own: Adam's steps are element by element.
    """
    levels, offsets = TreeLevels.build(skeleton.parents), torch.as_tensor(skeleton.offsets, dtype=torch.float32)
    target, local = (torch.as_tensor(each, dtype=torch.float32) for each in (positions, start[1]))
    change = torch.zeros((*local.shape[:2], 3), requires_grad=True)
    root = torch.as_tensor(positions[:, 0], dtype=torch.float32).requires_grad_(True)
    world = torch.eye(3).expand(len(local), 3, 3)
    optimizer = torch.optim.Adam([change, root], learning_rate)
    for _ in range(SMPLIFY_ITERATIONS):
        placed = compute_world_tensors(levels, offsets, root, _turn(local, change), world)
        cost = ((placed.position - target) ** 2).sum() + SMPLIFY_PRIOR_WEIGHT * (change**2).sum()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
    with torch.no_grad():
        return root.numpy().astype(float), _turn(local, change).numpy().astype(float)


def _turn(local: Tensor, change: Tensor) -> Tensor:
    return local @ compute_rotation_exponential(change)


PASS_COUNTS = (1, 2, 3)
MAX_SMPLIFY_PAIRS = 150  # for each offset
MAX_TAKES = 24  # that are followed, evenly over all
MIN_TAKE_FRAMES = 60
PIECE_FRAMES = 50  # length of the pieces of takes whose poses are refined
PIECE_COUNT = 16
LOST_LIMB = "left arm"
TIMED_BATCH_FRAMES = 512
SINGLE_FRAMES = 300  # evaluated one after the other
SPEED_REPEATS = 5  # the median counts


class PlugInCase(NamedTuple):
    """Pieces of takes with noisy joints, one piece after the other, and the poses that HybrIK-X finds."""

    true_positions: np.ndarray  # (T, J, 3) m
    given_positions: np.ndarray  # (T, J, 3) m, NaN where missing
    joint_sd: np.ndarray  # (T, J) m
    start: Poses


def measure_learned_ik(folder: Path, progress: ProgressCallback, network: IkNetwork | None = None) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON. Raises ReadError if the folder has no test.npz with motion.

    one_step_mm        by the number of frames between start and target; copied_mm: of the start; smplify_mm: of SMPLify
    one_step_passes_mm the same by the number of passes
    sequential_mm      whole takes followed from a true first frame; sequential_selected_mm: with the published selector
    plug_in_mm         see `measure_plug_in`
    fps_single         frames per second, one after the other; fps_batch: in batches of TIMED_BATCH_FRAMES
    over_smplify       how many times as fast as SMPLify single frames are
    """
    progress("reading")
    sequences = read_test_sequences(folder)
    model = PoseRegressor(network or load_shipped_ik_network(), load_cmu31_skeleton())
    results: dict[str, Any] = {"frames": len(sequences.rotations), "one_step_passes_mm": {}}
    progress("one step")
    for passes in PASS_COUNTS:
        each = PoseRegressor(model.network, model.skeleton, passes)
        results["one_step_passes_mm"][str(passes)] = measure_one_step(
            sequences, lambda batch, each=each: refine_batch(each, batch)
        )
    results["one_step_mm"] = results["one_step_passes_mm"]["1"]
    results["copied_mm"] = measure_one_step(sequences, lambda batch: (batch.target[0], batch.start[1]))
    progress("SMPLify")
    results["smplify_mm"] = measure_one_step(
        sequences, lambda batch: optimise_poses(batch.body, batch.start, batch.positions), MAX_SMPLIFY_PAIRS
    )
    progress("whole takes")
    results |= measure_sequential(sequences, model)
    progress("poses refined")
    results["plug_in_mm"] = measure_plug_in(sequences, model)
    progress("speed")
    return results | measure_speed(sequences, model)


def read_test_sequences(folder: Path) -> FrameSequences:
    """Return the frames of the test people in a folder. Raises ReadError if it has no test.npz with motion."""
    recordings = read_shard_recordings(folder / "test.npz")
    folded = (replace(each, rotations=fold_clavicles(each.rotations)) for each in recordings)
    sequences = build_sequences(folded, lambda _: None)
    if sequences is None:
        raise ReadError(f"{folder / 'test.npz'}: holds no motion.")
    return sequences


def refine_batch(model: PoseRegressor, batch: IkBatch) -> Poses:
    """Return the poses of pairs."""
    return model.refine_poses(batch.start, batch.positions, batch.joint_sd)


def measure_one_step(
    sequences: FrameSequences, solve: Callable[[IkBatch], Poses], max_pairs: int | None = None
) -> dict[str, float]:
    """Return the mean error in mm by the number of frames between start and target."""
    errors: dict[str, float] = {}
    for offset in SCORED_OFFSETS:
        batch = build_scored_pairs(sequences, offset)
        step = -(-len(batch.positions) // max_pairs) if max_pairs else 1
        batch = IkBatch(
            batch.body,
            (batch.start[0][::step], batch.start[1][::step]),
            (batch.target[0][::step], batch.target[1][::step]),
            batch.positions[::step],
            batch.joint_sd[::step],
        )
        errors[str(offset)] = compute_position_error_mm(solve(batch), batch.positions)
    return errors


def compute_position_error_mm(poses: Poses, true_positions: Float[np.ndarray, "T J 3"]) -> float:
    """Return the mean distance of all joints from the true ones in mm."""
    placed, _ = compute_tree_poses(build_kinematic_tree(load_cmu31_skeleton()), *poses)
    return 1e3 * float(np.linalg.norm(placed - true_positions, axis=-1).mean())


def measure_sequential(sequences: FrameSequences, model: PoseRegressor) -> dict[str, float]:
    """Return the median over takes of the mean error in mm of takes that are followed from a true first frame."""
    starts = np.unique(sequences.first[sequences.last - sequences.first >= MIN_TAKE_FRAMES])
    starts = starts[:: -(-len(starts) // MAX_TAKES)]
    errors: dict[str, list[float]] = {"sequential_mm": [], "sequential_selected_mm": []}
    worst: list[float] = []
    for first in starts:
        rotations = sequences.rotations[first : sequences.last[first] + 1].astype(float)
        root = np.zeros((len(rotations), 3))
        positions, _ = compute_tree_poses(build_kinematic_tree(model.skeleton), root, rotations)
        joint_sd = np.full(positions.shape[:2], KNOWN_JOINT_SD_M)
        for key, has_selector in (("sequential_mm", False), ("sequential_selected_mm", True)):
            poses = follow_take(model, (root[:1], rotations[:1]), positions, joint_sd, has_selector=has_selector)
            errors[key].append(compute_position_error_mm(poses, positions))
        worst.append(errors["sequential_mm"][-1])
    return {key: median(values) for key, values in errors.items()} | {"sequential_worst_take_mm": max(worst)}


def measure_plug_in(sequences: FrameSequences, model: PoseRegressor) -> dict[str, dict[str, float]]:
    """Return the mean errors in mm of HybrIK-X from joints with noise of SCORED_SD_M per axis, and of what follows it.

    "noise" has all joints, "arm_missing" lacks those of an arm. The rows: hybrik_x, hybrik_x_prior (solved under the default
    pose prior), pass_1 to pass_3 of the network; and the same from joints smoothed over time, smoothed_hybrik_x,
    smoothed_hybrik_x_prior and window (the last pass of the network).
    """
    results: dict[str, dict[str, float]] = {}
    prior = load_pose_model(DEFAULT_PRIOR_NAME, model.skeleton)
    for name, lost in (("noise", []), ("arm_missing", find_lost_joints(LOST_LIMB))):
        case = build_plug_in_case(sequences, lost)
        row = measure_hybrik_and_prior(case, prior)
        for passes in PASS_COUNTS:
            refined = PoseRegressor(model.network, model.skeleton, passes)
            poses = refined.refine_poses(case.start, case.given_positions, case.joint_sd)
            row[f"pass_{passes}"] = compute_position_error_mm(poses, case.true_positions)
        smoothed = smooth_case(case)
        row |= {f"smoothed_{key}": error_mm for key, error_mm in measure_hybrik_and_prior(smoothed, prior).items()}
        poses = PoseRegressor(model.network, model.skeleton, PASS_COUNTS[-1]).refine_poses(
            smoothed.start, smoothed.given_positions, smoothed.joint_sd
        )
        row["window"] = compute_position_error_mm(poses, case.true_positions)
        results[name] = row
    return results


def measure_hybrik_and_prior(case: PlugInCase, prior: PoseModel) -> dict[str, float]:
    """Return the mean errors in mm of HybrIK-X, and of the solve from there under a pose prior."""
    is_given = ~np.isnan(case.given_positions[..., 0])
    sd_m = float(np.sqrt((case.joint_sd[is_given] ** 2).mean()))
    task = JointTask(load_cmu31_skeleton(), case.start[1], is_given, np.nan_to_num(case.given_positions), sd_m)
    solved = solve_joint_task(task, prior, case.start)
    return {
        "hybrik_x": compute_position_error_mm(case.start, case.true_positions),
        "hybrik_x_prior": compute_position_error_mm((solved.root_position, solved.rotations), case.true_positions),
    }


def smooth_case(case: PlugInCase) -> PlugInCase:
    """Return the same pieces with joints smoothed over time, and HybrIK-X's poses from these."""
    parts = [
        smooth_positions(case.given_positions[piece], case.joint_sd[piece], TRAINING_RATE_HZ)
        for piece in (slice(first, first + PIECE_FRAMES) for first in range(0, len(case.true_positions), PIECE_FRAMES))
    ]
    given, joint_sd = (np.concatenate(each) for each in zip(*parts, strict=True))
    start = solve_hybrik(given, build_cmu41_subject(), joint_sd=joint_sd)
    return PlugInCase(case.true_positions, given, joint_sd, (start.root_position, start.local_rotations))


def build_plug_in_case(sequences: FrameSequences, lost_joints: list[int]) -> PlugInCase:
    """Return pieces of takes, evenly over all motion, with noise that is the same in every call."""
    skeleton, rng = load_cmu31_skeleton(), np.random.default_rng(0)
    firsts = np.flatnonzero(np.arange(len(sequences.rotations)) + PIECE_FRAMES - 1 <= sequences.last)
    firsts = firsts[np.linspace(0, len(firsts) - 1, PIECE_COUNT).astype(int)]
    rotations = np.concatenate([sequences.rotations[first : first + PIECE_FRAMES] for first in firsts]).astype(float)
    true, _ = compute_tree_poses(build_kinematic_tree(skeleton), np.zeros((len(rotations), 3)), rotations)
    given, joint_sd = true + SCORED_SD_M * rng.normal(size=true.shape), np.full(true.shape[:2], SCORED_SD_M)
    given[:, lost_joints] = np.nan
    start = solve_hybrik(given, build_cmu41_subject(), joint_sd=joint_sd)
    return PlugInCase(true, given, joint_sd, (start.root_position, start.local_rotations))


def measure_speed(sequences: FrameSequences, model: PoseRegressor) -> dict[str, float]:
    """Return frames per second of the network, and how many times as fast as SMPLify it is, on one core."""
    import torch

    batch = build_scored_pairs(sequences, SCORED_OFFSETS[-1])
    frames = np.arange(TIMED_BATCH_FRAMES) % len(batch.positions)
    start, positions = (batch.start[0][frames], batch.start[1][frames]), batch.positions[frames]
    joint_sd = batch.joint_sd[frames]
    singles = [((start[0][t : t + 1], start[1][t : t + 1]), positions[t : t + 1]) for t in range(SINGLE_FRAMES)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with use_one_core():
        batch_s = median(time_processor_rounds(lambda: model.refine_poses(start, positions, joint_sd), 4 * SPEED_REPEATS))

        def refine_singles() -> None:
            for pose, given in singles:
                model.refine_poses(pose, given, joint_sd[:1])

        single_s = median(time_processor_rounds(refine_singles, SPEED_REPEATS)) / SINGLE_FRAMES
        smplify_s = median(time_processor_rounds(lambda: optimise_poses(model.skeleton, *singles[0]), SPEED_REPEATS))
    torch.set_num_threads(threads)
    return {"fps_single": 1 / single_s, "fps_batch": TIMED_BATCH_FRAMES / batch_s, "over_smplify": smplify_s / single_s}


def time_processor_rounds(call: Callable[[], object], rounds: int) -> list[float]:
    """Return the processor seconds of each round, after one call that is not timed and may compile."""
    call()
    durations_s: list[float] = []
    for _ in range(rounds):
        started = time.process_time()
        call()
        durations_s.append(time.process_time() - started)
    return durations_s


@contextmanager
def use_one_core() -> Generator[None]:
    """Limit this process to one core inside the context, where the system allows it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


FIRST_SELECTED_FRAME = 60  # from this frame on, the published sequential protocol selects among three poses


def follow_take(
    model: PoseRegressor,
    first: Poses,
    positions: Float[np.ndarray, "T J 3"],
    joint_sd: Float[np.ndarray, "T J"],
    *,
    has_selector: bool = False,
) -> Poses:
    """Return the poses of all frames, each started from the frame before (3.2.3); the first one from `first` (one frame).

    has_selector  from FIRST_SELECTED_FRAME on, keep whichever has the least joint error: the prediction, a prediction from
                  the pose of the first frame, or a copy of the pose before. The published code does this.
    """
    root, local = np.empty(positions.shape[::2]), np.empty((*positions.shape[:2], 3, 3))
    current = first
    for t in range(len(positions)):
        given, sd = positions[t : t + 1], joint_sd[t : t + 1]
        predicted = model.refine_poses(current, given, sd)
        if has_selector and t >= FIRST_SELECTED_FRAME:
            restarted = model.refine_poses((root[:1], local[:1]), given, sd)
            candidates = (predicted, restarted, (given[:, 0], current[1]))
            errors = [_compute_joint_error(model.skeleton, each, given) for each in candidates]
            predicted = candidates[int(np.argmin(errors))]
        current = predicted
        root[t], local[t] = current[0][0], current[1][0]
    return root, local


def _compute_joint_error(skeleton: Skeleton, poses: Poses, positions: Float[np.ndarray, "T J 3"]) -> float:
    placed, _ = compute_tree_poses(build_kinematic_tree(skeleton), *poses)
    return float(np.nanmean(np.linalg.norm(placed - positions, axis=-1)))

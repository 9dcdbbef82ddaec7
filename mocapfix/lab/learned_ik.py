"""Benchmark of learned inverse kinematics (Learnable SMPLify): one step, whole takes, other methods' poses refined, and speed.

Motion is that of people that no training has read, on the average body; errors are those of 31 joints after forward kinematics.
All times are processor times of one thread. The baseline is SMPLify's optimisation with Adam, from the given start and root: the
cost is the squared distance of the joints, and a weak pull of the rotations towards the start.
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
from mocapfix.lab.hybrik_tables import build_cmu41_subject
from mocapfix.lab.learned_ik_training import (
    KNOWN_JOINT_SD_M,
    SCORED_OFFSETS,
    SCORED_SD_M,
    TreeLevels,
    build_scored_pairs,
    compute_world_tensors,
    find_lost_joints,
)
from mocapfix.lab.networks import compute_rotation_tensor, use_one_torch_thread
from mocapfix.lab.recordings import TRAINING_RATE_HZ, fold_clavicles, read_shard_recordings
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.solve.hybrik import solve_hybrik
from mocapfix.solve.kinematics import Poses, build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import Perceptron, PoseRegressor, load_shipped_ik_network, smooth_positions
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
    return local @ compute_rotation_tensor(change)


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


def measure_learned_ik(folder: Path, progress: ProgressCallback, network: Perceptron | None = None) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON. Raises ReadError if the folder has no test.npz with motion.

    - `one_step_mm`: by the number of frames between start and target; copied_mm: of the start; smplify_mm: of SMPLify
    - `one_step_passes_mm`: the same by the number of passes
    - `sequential_mm`: whole takes followed from a true first frame
    - `plug_in_mm`: see `measure_plug_in`
    - `fps_single`: frames per second, one after the other; fps_batch: in batches of TIMED_BATCH_FRAMES
    - `over_smplify`: how many times as fast as SMPLify single frames are
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
    """Return the mean error in mm of takes that are followed from a true first frame: the median over takes, and the worst."""
    starts = np.unique(sequences.first[sequences.last - sequences.first >= MIN_TAKE_FRAMES])
    errors: list[float] = []
    for first in starts[:: -(-len(starts) // MAX_TAKES)]:
        rotations = sequences.rotations[first : sequences.last[first] + 1].astype(float)
        root = np.zeros((len(rotations), 3))
        positions, _ = compute_tree_poses(build_kinematic_tree(model.skeleton), root, rotations)
        errors.append(compute_position_error_mm(follow_take(model, (root[:1], rotations[:1]), positions), positions))
    return {"sequential_mm": median(errors), "sequential_worst_take_mm": max(errors)}


def follow_take(model: PoseRegressor, first: Poses, positions: Float[np.ndarray, "T J 3"]) -> Poses:
    """Return the poses of all frames, each started from the frame before; the first one from `first` (one frame)."""
    joint_sd, current = np.full((1, positions.shape[1]), KNOWN_JOINT_SD_M), first
    poses = [current := model.refine_poses(current, given[None], joint_sd) for given in positions]
    root, local = zip(*poses, strict=True)
    return np.concatenate(root), np.concatenate(local)


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
    batch = build_scored_pairs(sequences, SCORED_OFFSETS[-1])
    frames = np.arange(TIMED_BATCH_FRAMES) % len(batch.positions)
    start, positions = (batch.start[0][frames], batch.start[1][frames]), batch.positions[frames]
    joint_sd = batch.joint_sd[frames]
    singles = [((start[0][t : t + 1], start[1][t : t + 1]), positions[t : t + 1]) for t in range(SINGLE_FRAMES)]
    with use_one_torch_thread(), use_one_core():
        batch_s = median(time_processor_rounds(lambda: model.refine_poses(start, positions, joint_sd), 4 * SPEED_REPEATS))

        def refine_singles() -> None:
            for pose, given in singles:
                model.refine_poses(pose, given, joint_sd[:1])

        single_s = median(time_processor_rounds(refine_singles, SPEED_REPEATS)) / SINGLE_FRAMES
        smplify_s = median(time_processor_rounds(lambda: optimise_poses(model.skeleton, *singles[0]), SPEED_REPEATS))
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

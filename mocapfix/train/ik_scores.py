"""Scores of learned inverse kinematics on people that it was not trained on: one step from a frame nearby, and hard inputs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.skeleton import BODY_SECTIONS, load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.train.frame_pairs import FrameSequences, IkBatch

SCORED_OFFSETS = (1, 3, 5, 7, 9)  # frames between start and target
MAX_SCORED_PAIRS = 4000  # for each offset, evenly over all trials
SCORED_SD_M = 0.02  # noise of the joints of the second score, standard deviation per axis
KNOWN_JOINT_SD_M = 1e-3  # standard deviation that is given for joints without noise
LOST_SECTION = "left arm"  # of the third score; the shoulder itself stays


class IkScores(NamedTuple):
    """Mean errors over poses and joints.

    one_step_mm   by the number of frames between start and target
    rotation_deg  the same, of world rotations
    copied_mm     of the start itself
    noisy_mm      with noise of SCORED_SD_M, from the nearest start
    limb_mm       the same, an arm not given
    """

    one_step_mm: dict[int, float]
    rotation_deg: dict[int, float]
    copied_mm: dict[int, float]
    noisy_mm: float
    limb_mm: float


PosePredictor = Callable[[IkBatch], tuple[Float[np.ndarray, "B J 3"], Float[np.ndarray, "B J 3 3"]]]
"""A function that returns world positions in metres and rotations for a batch of pairs."""


def measure_ik_scores(predict: PosePredictor, sequences: FrameSequences, has_corruption: bool) -> IkScores:
    """Return the scores; those of hard inputs are NaN if the network was not trained for them."""
    one_step, rotation, copied = {}, {}, {}
    for offset in SCORED_OFFSETS:
        batch = build_scored_pairs(sequences, offset)
        one_step[offset], rotation[offset] = compute_errors(predict, batch)
        copied[offset], _ = compute_errors(lambda each: place_poses(each, each.start[1]), batch)
    if not has_corruption:
        return IkScores(one_step, rotation, copied, np.nan, np.nan)
    batch = add_scored_noise(build_scored_pairs(sequences, SCORED_OFFSETS[0]))
    noisy_mm, _ = compute_errors(predict, batch)
    positions = batch.positions.copy()
    positions[:, find_lost_joints(LOST_SECTION)] = np.nan
    limb_mm, _ = compute_errors(predict, batch._replace(positions=positions))
    return IkScores(one_step, rotation, copied, noisy_mm, limb_mm)


def compute_errors(predict: PosePredictor, batch: IkBatch) -> tuple[float, float]:
    """Return the mean errors of joint positions in mm and of world rotations in degrees."""
    (positions, rotations), (true_positions, true_rotations) = predict(batch), place_poses(batch, batch.target[1])
    cosine = (np.einsum("bjxy,bjxy->bj", rotations, true_rotations) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return 1e3 * float(np.linalg.norm(positions - true_positions, axis=-1).mean()), float(angle.mean())


def place_poses(
    batch: IkBatch, rotations: Float[np.ndarray, "B J 3 3"]
) -> tuple[Float[np.ndarray, "B J 3"], Float[np.ndarray, "B J 3 3"]]:
    """Return world positions and rotations of local rotations at the true root positions."""
    return compute_tree_poses(build_kinematic_tree(batch.body), batch.target[0], rotations)


def build_scored_pairs(sequences: FrameSequences, offset: int) -> IkBatch:
    """Return pairs `offset` frames apart, evenly over all trials, on the average body with all joints given."""
    frames = find_targets(sequences, offset)
    target, start = (sequences.rotations[each].astype(float) for each in (frames, frames - offset))
    body, root = load_cmu31_skeleton(), np.zeros((len(frames), 3))
    positions, _ = compute_tree_poses(build_kinematic_tree(body), root, target)
    return IkBatch(body, (root, start), (root, target), positions, np.full(positions.shape[:2], KNOWN_JOINT_SD_M))


def find_targets(sequences: FrameSequences, offset: int) -> Int[np.ndarray, " B"]:
    """Return frames that have a start in their trial, at most MAX_SCORED_PAIRS."""
    frames = np.arange(len(sequences.rotations))
    frames = frames[frames - offset >= sequences.first]
    return frames[:: max(1, -(-len(frames) // MAX_SCORED_PAIRS))]


def add_scored_noise(batch: IkBatch) -> IkBatch:
    """Return the pairs with noise of SCORED_SD_M, always the same."""
    noise = SCORED_SD_M * np.random.default_rng(0).normal(size=batch.positions.shape)
    return batch._replace(positions=batch.positions + noise, joint_sd=np.full(batch.joint_sd.shape, SCORED_SD_M))


def find_lost_joints(section: str) -> list[int]:
    """Return the joints beyond the first one of a limb."""
    skeleton = load_cmu31_skeleton()
    return [skeleton.find_joint(name) for name in BODY_SECTIONS[section][1:]]

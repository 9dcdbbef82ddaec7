"""Poses that come from other skeletons, in the conventions of the CMU database.

Motion that was transferred from another skeleton lacks what that skeleton does not have: toes, fingers and thumbs are constant,
and the bend of trunk and neck is divided among their joints by a fixed rule. A model that is trained on it learns that these
joints do not move. The zero position of the wrists differs as well, from person to person. Therefore the mean rotation of each
person's wrists is moved so that these means are distributed as those of CMU's people. The joints that the motion does not show
are drawn from a Gaussian of CMU's poses, given the observed joints and the sums of trunk and neck.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.train.training_poses import TrainingPoses, add_mirrored_poses, compute_sampling_weights

MATCHED_JOINTS = ("LeftHand", "LeftFingerBase", "RightHand", "RightFingerBase")  # the forearm's roll and the wrist's bend
UNOBSERVED_JOINT_ENDINGS = ("ToeBase", "HandIndex1", "Thumb")  # constant in retargeted motion
REDIVIDED_CHAINS = (("LowerBack", "Spine", "Spine1"), ("Neck", "Neck1", "Head"))  # only the sum of their rotations is observed
MIN_SUBJECT_FRAMES = 400  # the mean pose of people with fewer frames says little about them
OBSERVATION_NOISE_SD_RAD = np.radians(1.0)  # of the observed joints, when the others are drawn given them
MIN_POSE_SD_RAD = np.radians(0.5)  # added to the covariance, since some joints never move
CHUNK_POSES = 50_000  # poses that are drawn at a time, which limits the memory


class PoseDistribution(NamedTuple):
    """A Gaussian of pose vectors, 3 J numbers a pose: mean (F,) in radians and covariance (F, F)."""

    mean: np.ndarray
    covariance: np.ndarray


def conform_training_poses(poses: TrainingPoses, joint_names: tuple[str, ...], subject_balance: float) -> TrainingPoses:
    """Return training and held-out poses, those that are retargeted in the conventions of the others.

    subject_balance  of the poses whose conventions are learned, see `compute_sampling_weights`
    """
    training_count, held_out_count = len(poses.subject_index) // 2, len(poses.held_out_index) // 2  # without mirror images
    subject_index = np.concatenate([poses.subject_index[:training_count], poses.held_out_index[:held_out_count]])
    vectors = np.concatenate([poses.training_vectors[:training_count], poses.held_out_vectors[:held_out_count]])
    weights = np.zeros(len(vectors))
    weights[:training_count] = compute_sampling_weights(subject_index[:training_count], subject_balance)
    conformed = conform_retargeted_poses(vectors, subject_index, poses.is_retargeted[subject_index], weights, joint_names)
    training_vectors, held_out_vectors = np.split(conformed, [training_count])
    return replace(
        poses,
        training_vectors=add_mirrored_poses(training_vectors, joint_names),
        held_out_vectors=add_mirrored_poses(held_out_vectors, joint_names),
    )


def conform_retargeted_poses(
    pose_vectors: Float[np.ndarray, "N J 3"],
    subject_index: Int[np.ndarray, " N"],
    is_retargeted: Bool[np.ndarray, " N"],
    reference_weights: Float[np.ndarray, " N"],
    joint_names: tuple[str, ...],
) -> Float[np.ndarray, "N J 3"]:
    """Return the poses, those that are retargeted in the conventions of the others.

    reference_weights  weights of the poses that have the conventions; 0 for those that shall not be learned from
    """
    is_reference = (reference_weights > 0) & ~is_retargeted
    if not is_retargeted.any() or not is_reference.any():
        return pose_vectors
    distribution = fit_pose_distribution(pose_vectors[is_reference], reference_weights[is_reference], joint_names)
    conformed = match_subject_means(pose_vectors, subject_index, is_retargeted, reference_weights > 0, joint_names)
    rng = np.random.default_rng(0)
    for chunk in np.split(np.flatnonzero(is_retargeted), range(CHUNK_POSES, int(is_retargeted.sum()), CHUNK_POSES)):
        conformed[chunk] = draw_unobserved_joints(conformed[chunk], distribution, joint_names, rng)
    return conformed


def fit_pose_distribution(
    pose_vectors: Float[np.ndarray, "N J 3"], weights: Float[np.ndarray, " N"], joint_names: tuple[str, ...]
) -> PoseDistribution:
    """Return the Gaussian of weighted poses and their mirror images."""
    rows = add_mirrored_poses(pose_vectors, joint_names).reshape(2 * len(weights), -1)
    both = np.tile(weights, 2) / (2 * weights.sum())
    mean = both @ rows
    deviations = rows - mean
    covariance = (deviations * both[:, None]).T @ deviations
    return PoseDistribution(mean, covariance + MIN_POSE_SD_RAD**2 * np.eye(len(mean)))


def match_subject_means(
    pose_vectors: Float[np.ndarray, "N J 3"],
    subject_index: Int[np.ndarray, " N"],
    is_retargeted: Bool[np.ndarray, " N"],
    is_training: Bool[np.ndarray, " N"],
    joint_names: tuple[str, ...],
) -> Float[np.ndarray, "N J 3"]:
    """Return poses whose wrists have means per person that are distributed as those of the people who are not retargeted.

    Mean and standard deviation over people are measured on the training people, and on both sides of the body together.
    """
    matched = pose_vectors.copy()
    wrists = [joint_names.index(name) for name in MATCHED_JOINTS]
    numbers = np.unique(subject_index)
    first = np.array([np.flatnonzero(subject_index == number)[0] for number in numbers])
    counts = np.array([(subject_index == number).sum() for number in numbers])
    means = np.stack([pose_vectors[subject_index == number].mean(axis=0) for number in numbers])
    both_sides = add_mirrored_poses(means, joint_names).reshape(2, *means.shape)
    moved, is_measured = is_retargeted[first], is_training[first] & (counts >= MIN_SUBJECT_FRAMES)
    if not (moved & is_measured).any() or not (~moved & is_measured).any():
        return matched
    own, reference = both_sides[:, moved & is_measured], both_sides[:, ~moved & is_measured]
    scale = np.minimum(1.0, reference.std(axis=(0, 1)) / np.maximum(own.std(axis=(0, 1)), MIN_POSE_SD_RAD))
    targets = reference.mean(axis=(0, 1)) + scale * (means - own.mean(axis=(0, 1)))
    for number, offset in zip(numbers[moved], (targets - means)[moved], strict=True):
        matched[np.ix_(subject_index == number, wrists)] += offset[wrists].astype(pose_vectors.dtype)
    return matched


def draw_unobserved_joints(
    pose_vectors: Float[np.ndarray, "N J 3"],
    distribution: PoseDistribution,
    joint_names: tuple[str, ...],
    rng: np.random.Generator,
) -> Float[np.ndarray, "N J 3"]:
    """Return poses with the same observed joints and sums, and other joints drawn given these."""
    observation = build_observation_matrix(joint_names)
    covariance = distribution.covariance
    innovation = observation @ covariance @ observation.T + OBSERVATION_NOISE_SD_RAD**2 * np.eye(len(observation))
    gain = np.linalg.solve(innovation, observation @ covariance).T
    remaining, axes = np.linalg.eigh(covariance - gain @ observation @ covariance)
    root = axes * np.sqrt(np.maximum(remaining, 0.0))
    deviations = pose_vectors.reshape(len(pose_vectors), -1) - distribution.mean
    drawn = deviations @ observation.T @ gain.T + rng.standard_normal(deviations.shape) @ root.T
    drawn += (deviations - drawn) @ observation.T @ np.linalg.pinv(observation).T  # what is observed remains exactly as it was
    return (distribution.mean + drawn).reshape(pose_vectors.shape).astype(pose_vectors.dtype)


def build_observation_matrix(joint_names: tuple[str, ...]) -> Float[np.ndarray, "O F"]:
    """Return the matrix that gives what retargeted motion shows of a pose: its observed joints, and the sums of its chains."""
    divided = {name for chain in REDIVIDED_CHAINS for name in chain}
    observed = [(name,) for name in joint_names if name not in divided and not name.endswith(UNOBSERVED_JOINT_ENDINGS)]
    rows = np.zeros((len(observed) + len(REDIVIDED_CHAINS), len(joint_names)))
    for row, names in zip(rows, [*observed, *REDIVIDED_CHAINS], strict=True):
        row[[joint_names.index(name) for name in names]] = 1.0
    return np.kron(rows, np.eye(3))

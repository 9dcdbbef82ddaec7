"""Training poses: motion without position, heading and rotation jumps, each pose also mirrored.

Poses that come from other skeletons, in the conventions of the CMU database.

Motion that was transferred from another skeleton lacks what that skeleton does not have: toes, fingers and thumbs are constant,
and the bend of trunk and neck is divided among their joints by a fixed rule. A model that is trained on it learns that these
joints do not move. The zero position of the wrists differs as well, from person to person. Therefore the mean rotation of each
person's wrists is moved so that these means are distributed as those of CMU's people. The joints that the motion does not show
are drawn from a Gaussian of CMU's poses, given the observed joints and the sums of trunk and neck.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.lab.recordings import RecordingSource, read_recordings
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.pose_prior import compute_pose_vectors

# Joints on which the data hold little information, so that their jumps do not matter.
WEAKLY_OBSERVED_JOINTS = ("HipJoint", "FingerBase", "HandIndex1", "Thumb", "ToeBase")
MAX_JOINT_SPEED_RAD_S = 30.0  # a faster rotation is a jump of the solved motion; no joint of the recorded subjects was so fast
MIRROR_X_MATRIX = np.diag([-1.0, 1.0, 1.0])  # left becomes right, x changes sign


@dataclass(frozen=True)
class TrainingPoses:
    """Poses as rotation vectors from a reference pose, the root's is its tilt, in radians and single precision."""

    training_vectors: np.ndarray  # (N, J, 3) of the subjects to train on; the second half is the first, mirrored
    held_out_vectors: np.ndarray  # (M, J, 3) of the held-out subjects; the second half is the first, mirrored
    subject_index: np.ndarray  # (N,) the number of the subject of each training pose
    held_out_index: np.ndarray  # (M,) the same of each held-out pose
    is_retargeted: np.ndarray  # (S,) by the number of a subject: whether the motion was transferred from another skeleton
    frame_counts: Counter[str]  # frames of each subject before mirroring
    dropped_frames: int  # number of frames beyond a rotation jump, which are not used
    # frames of each known source before mirroring
    source_frames: Counter[RecordingSource] = field(default_factory=Counter[RecordingSource])


def gather_training_poses(
    folders: Sequence[Path],
    reference_rotations: Float[np.ndarray, "J 3 3"],
    test_subjects: frozenset[str],
    held_out_subjects: frozenset[str],
    progress: Callable[[str], object],
) -> TrainingPoses:
    """Return all poses in folders except those of `test_subjects`.

    Raises:
        ReadError: If the folders hold no motion of the training subjects or none of the held-out subjects.
    """
    joint_names = load_cmu31_body().skeleton.names
    is_observed, frame_counts, dropped_frames = ~find_weakly_observed_joints(joint_names), Counter[str](), 0
    training: list[np.ndarray] = []
    held_out: list[np.ndarray] = []
    subjects: tuple[list[str], list[str]] = ([], [])
    retargeted_subjects: set[str] = set()
    source_frames = Counter[RecordingSource]()
    for recording in read_recordings(folders):
        if recording.subject in test_subjects:
            continue
        progress(f"reading {recording.name}")
        kept = find_longest_jump_free_slice(recording.rotations[:, is_observed], recording.rate_hz)
        # Single precision, because there may be millions of poses.
        vectors = compute_pose_vectors(recording.rotations[kept], reference_rotations).astype(np.float32)
        is_held_out = recording.subject in held_out_subjects
        (held_out if is_held_out else training).append(vectors)
        subjects[is_held_out].extend([recording.subject] * len(vectors))
        frame_counts[recording.subject] += len(vectors)
        source_frames[recording.source] += len(vectors)
        if recording.source.is_retargeted:
            retargeted_subjects.add(recording.subject)
        dropped_frames += len(recording.rotations) - len(vectors)
    held_out_description = f"the held-out subjects {', '.join(sorted(held_out_subjects))}"
    for parts, description in ((training, "the training subjects"), (held_out, held_out_description)):
        if not any(map(len, parts)):
            raise ReadError(f"{', '.join(map(str, folders))}: no motion of {description}.")
    numbered = sorted(frame_counts)
    training_index, held_out_index = (np.tile(np.searchsorted(numbered, names), 2) for names in subjects)
    return TrainingPoses(
        add_mirrored_poses(np.concatenate(training), joint_names),
        add_mirrored_poses(np.concatenate(held_out), joint_names),
        training_index,
        held_out_index,
        np.isin(numbered, sorted(retargeted_subjects)),
        frame_counts,
        dropped_frames,
        source_frames,
    )


def compute_sampling_weights(
    subject_index: Int[np.ndarray, " N"],
    balance: float,
    is_retargeted: Bool[np.ndarray, " S"] | None = None,
    retargeted_weight: float = 1.0,
) -> Float[np.ndarray, " N"]:
    """Return the relative sampling frequency of each pose: 1 for a balance of 0, the inverse of the subject's poses for 1.

    Args:
        is_retargeted: By the number of a subject; the frequency of these poses is multiplied by `retargeted_weight`.
    """
    weights = np.bincount(subject_index)[subject_index] ** -float(balance)
    return weights if is_retargeted is None else np.where(is_retargeted[subject_index], retargeted_weight * weights, weights)


def find_weakly_observed_joints(joint_names: tuple[str, ...]) -> Bool[np.ndarray, " J"]:
    """Return which joints are weakly observed."""
    return np.array([name.endswith(WEAKLY_OBSERVED_JOINTS) for name in joint_names])


def detect_rotation_jumps(rotations: Float[np.ndarray, "T J 3 3"], rate_hz: float) -> Bool[np.ndarray, "_ J"]:
    """Return whether rotations jump from each of the T - 1 frames to the next.

    The solved motion of the CMU database has joints that flip from one frame to the next and remain flipped.
    """
    cosines = (np.einsum("t...ab,t...ab->t...", rotations[1:], rotations[:-1]) - 1) / 2
    return np.arccos(np.clip(cosines, -1, 1)) * rate_hz >= MAX_JOINT_SPEED_RAD_S


def find_longest_jump_free_slice(rotations: Float[np.ndarray, "T J 3 3"], rate_hz: float) -> slice:
    """Return the longest range of frames in which no joint jumps.

    The data do not show which side of a jump is correct; the longer one is more likely.
    """
    has_jump = detect_rotation_jumps(rotations, rate_hz).any(axis=1)
    bounds = np.concatenate([[0], np.flatnonzero(has_jump) + 1, [len(rotations)]])
    longest = int(np.diff(bounds).argmax())
    return slice(int(bounds[longest]), int(bounds[longest + 1]))


def mirror_joint_name(name: str) -> str:
    """Return the joint on the other side: LeftArm for RightArm, LThumb for RThumb."""
    for left, right in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
        if name.startswith(left):
            return right + name[len(left) :]
        if name.startswith(right):
            return left + name[len(right) :]
    return name


def add_mirrored_poses(pose_vectors: Float[np.ndarray, "N J 3"], joint_names: tuple[str, ...]) -> Float[np.ndarray, "M J 3"]:
    """Return poses, followed by their mirror images."""
    return np.concatenate([pose_vectors, mirror_pose_vectors(pose_vectors, joint_names)])


def mirror_pose_vectors(pose_vectors: Float[np.ndarray, "N J 3"], joint_names: tuple[str, ...]) -> Float[np.ndarray, "N J 3"]:
    """Return mirrored poses, given rotation vectors from a reference pose that is its own mirror image.

    Rotation about x, which is perpendicular to the mirror plane, is unchanged; rotations about y and z change sign.
    """
    mirrored_index = [joint_names.index(mirror_joint_name(name)) for name in joint_names]
    return pose_vectors[:, mirrored_index] * np.array([1, -1, -1], pose_vectors.dtype)


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

    Args:
        subject_balance: Of the poses whose conventions are learned, see `compute_sampling_weights`.
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

    Args:
        reference_weights: Weights of the poses that have the conventions; 0 for those that shall not be learned from.
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

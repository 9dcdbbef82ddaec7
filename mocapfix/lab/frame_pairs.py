"""Training pairs of learned inverse kinematics (Learnable SMPLify, 3.2.3), and examples of the twist regressor.

A pair is a start pose and the joints of a target pose. Most starts are frames of the same trial, 1 to 9 frames before or after
(Eq. 17; both signs, which is the paper's swap). The others are what the network meets besides: frames further away, the mean
pose, frames of other people, perturbed poses, and the result of a first pass. The given positions have noise of a known standard
deviation, and joints and whole limbs are missing. Examples of twists are on bodies of different proportions.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab.recordings import Recording, RecordingSource, read_recordings
from mocapfix.lab.settings import LearnedIkSettings
from mocapfix.lab.training_poses import (
    MIRROR_X_MATRIX,
    find_longest_jump_free_slice,
    find_weakly_observed_joints,
    mirror_joint_name,
)
from mocapfix.model.skeleton import BODY_SECTIONS, Skeleton, load_cmu31_body, load_cmu31_skeleton
from mocapfix.solve.hybrik import build_twist_spans, compute_bone_vectors, compute_span_directions
from mocapfix.solve.kinematics import Poses, build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import build_transfer_tree, correct_poses, transfer_poses
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations

BODIES_PER_EPOCH = 40
MAX_DISPLACEMENT_M = 0.03  # maximum displacement of a joint along each axis
UNDISPLACED_POSE_SHARE = 0.3  # fraction of the poses whose joints are not displaced
LOSSY_POSE_SHARE = 0.5  # fraction of the poses that have missing joints
LOST_JOINT_SHARE = 0.15  # fraction of the joints of these poses that are missing
PELVIS_JOINTS = ("Hips", "LeftUpLeg", "RightUpLeg")  # their positions determine the root's rotation

HAS_TWIST = ~np.isnan(compute_bone_vectors(load_cmu31_skeleton())[:, 0])  # (J,) the joints that have a bone, and so a twist
INPUT_COUNT = 6 * len(build_twist_spans().start)


def compute_local_rotations(
    pose_vectors: Float[np.ndarray, "N J 3"], reference_rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return the local rotations of poses in single precision, the root's as the identity."""
    difference = Rotation.from_rotvec(pose_vectors.reshape(-1, 3)).as_matrix().astype(np.float32)
    local = difference.reshape(*pose_vectors.shape, 3) @ reference_rotations.astype(np.float32)
    local[:, 0] = np.eye(3)
    return local


def build_epoch_examples(
    rotations: Float[np.ndarray, "N J 3 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N I"], Float[np.ndarray, "N O"]]:
    """Return inputs and targets of poses, shared among BODIES_PER_EPOCH random bodies."""
    parts = [build_examples(part, draw_body(rng), rng) for part in np.array_split(rotations, BODIES_PER_EPOCH) if len(part)]
    inputs, targets = (np.concatenate(each) for each in zip(*parts, strict=True))
    return inputs, targets.reshape(len(targets), -1)


def draw_body(rng: np.random.Generator) -> Skeleton:
    """Return the average body with random shape components."""
    body = load_cmu31_body()
    offsets = np.tensordot(rng.normal(size=len(body.shape_components)), body.shape_components, 1)
    return replace(body.skeleton, offsets=body.skeleton.offsets + offsets)


def build_examples(
    rotations: Float[np.ndarray, "N J 3 3"], body: Skeleton, rng: np.random.Generator | None
) -> tuple[Float[np.ndarray, "N I"], Float[np.ndarray, "N B 2"]]:
    """Return inputs and targets of the poses of a body. Without a random generator, all joints are at their true positions."""
    zeros, local = np.zeros((len(rotations), 3)), np.ascontiguousarray(rotations, float)
    positions, _ = compute_tree_poses(build_kinematic_tree(body), zeros, local)
    if rng is None:
        pelvis_rotation = estimate_pelvis_rotation(positions, body)
        return compute_span_directions(positions, pelvis_rotation), compute_twist_targets(rotations, body)
    amplitude = rng.random((len(rotations), 1, 1))
    displacement = MAX_DISPLACEMENT_M * amplitude * (rng.random((len(rotations), 1, 1)) > UNDISPLACED_POSE_SHARE)
    positions += displacement * rng.uniform(-1, 1, positions.shape)
    pelvis_rotation = estimate_pelvis_rotation(positions, body)
    joint_draw, pose_draw = rng.random(positions.shape[:2]), rng.random((len(rotations), 1))
    positions[(joint_draw < LOST_JOINT_SHARE) & (pose_draw < LOSSY_POSE_SHARE)] = np.nan
    return compute_span_directions(positions, pelvis_rotation), compute_twist_targets(rotations, body)


def compute_twists(
    rotations: Float[np.ndarray, "*batch J 3 3"], bones: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "*batch J 2"]:
    """Return the cosine and sine of the angle about each bone in local rotations; NaN for joints without a bone.

    R = swing twist: as a quaternion it has the scalar part cos(s/2) cos(t/2) and the part cos(s/2) sin(t/2) along the bone, for
    the angles s and t. A bone that swings to the opposite direction has no finite twist.
    """
    u = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    along = np.einsum("ja,...jab,jb->...j", u, rotations, u)
    skew = rotations - np.swapaxes(rotations, -1, -2)
    axis = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    both = np.stack([np.trace(rotations, axis1=-2, axis2=-1) - along, (axis * u).sum(-1)], axis=-1)
    return both / (1 + along)[..., None]


def compute_twist_targets(rotations: Float[np.ndarray, "N J 3 3"], body: Skeleton) -> Float[np.ndarray, "N B 2"]:
    """Return cosine and sine of the twists of all bones in local rotations."""
    return compute_twists(rotations[:, HAS_TWIST], compute_bone_vectors(body)[HAS_TWIST]).astype(np.float32)


def estimate_pelvis_rotation(joint_positions: Float[np.ndarray, "N J 3"], body: Skeleton) -> Float[np.ndarray, "N 3 3"]:
    """Return the rotation of the root, estimated from the positions of the pelvis joints."""
    pelvis = [body.find_joint(name) for name in PELVIS_JOINTS]
    weights = np.ones((len(joint_positions), len(pelvis)))
    cross_covariance, _, _ = compute_cross_covariance(joint_positions[:, pelvis], body.offsets[pelvis], weights)
    return fit_rotations(cross_covariance)


FAR_START_SHARE = 0.1  # fraction of the pairs whose start is further away in the trial than the settings say
MAX_FAR_START_FRAMES = 60  # by how much at most
MEAN_POSE_SHARE = 0.15  # fraction whose start is the mean pose
OTHER_POSE_SHARE = 0.1  # fraction whose start is any pose
PERTURBED_SHARE = 0.3  # fraction whose start is perturbed
MAX_PERTURBATION_RAD = 0.2  # standard deviation per axis of the largest perturbation
SECOND_PASS_SHARE = 0.25  # fraction whose start is the result of the closed form for the same joints, as HybrIK's poses are
START_ROOT_SD_M = 0.1  # standard deviation per axis of the start's position
START_TILT_SD_RAD = 0.3  # of the root rotation of starts that are not frames of the trial
EXACT_SHARE = 0.35  # fraction of the pairs whose joint positions have no noise
EXACT_SD_M = (1e-4, 2e-3)  # range of their standard deviations
NOISY_SD_M = (1e-3, 4e-2)  # range of the others'
JOINT_SD_SPREAD = 0.4  # of the logarithm of the joints' standard deviations in one pose
MISSING_SHARE = 0.5  # fraction of the pairs with missing joints; of half of them whole limbs
MAX_MISSING_JOINT_SHARE = 0.4  # of single joints
LIMB_SECTIONS = ("head", "left arm", "right arm", "left leg", "right leg")
MEAN_LOST_LIMBS = 1.4  # of poses that lack limbs
SIZE_SD = 0.08  # of the logarithm of the bodies' sizes


@dataclass(frozen=True)
class FrameSequences:
    """Frames of trials of people, one trial after the other."""

    rotations: Float32[np.ndarray, "N J 3 3"]  # (N, J, 3, 3) local rotations, single precision
    first: Int[np.ndarray, " N"]  # first, last: (N,) the first and the last frame of each frame's trial
    last: Int[np.ndarray, " N"]
    subject_index: Int[np.ndarray, " N"]  # number of the subject
    subjects: tuple[str, ...]  # names of the subjects
    is_retargeted: Bool[np.ndarray, " S"]  # whether the motion of each subject was transferred from another skeleton
    source_frames: Counter[RecordingSource]  # number of frames of each source

    @property
    def frame_counts(self) -> Counter[str]:
        """The number of frames of each subject."""
        return Counter(dict(zip(self.subjects, np.bincount(self.subject_index).tolist(), strict=True)))


class IkBatch(NamedTuple):
    """Pairs of one body."""

    body: Skeleton
    start: Poses  # root positions in metres and local rotations
    target: Poses  # the same of the true poses
    positions: Float[np.ndarray, "B J 3"]  # m: given joints, NaN where missing
    joint_sd: Float[np.ndarray, "B J"]  # m per axis


def gather_sequences(
    folders: Sequence[Path], is_selected: Callable[[str], bool], progress: Callable[[str], object]
) -> FrameSequences:
    """Return the frames of the selected subjects, without those beyond a rotation jump. Raises ReadError if there are none."""
    selected = (each for each in read_recordings(folders) if is_selected(each.subject))
    sequences = build_sequences(selected, progress)
    if sequences is None:
        raise ReadError(f"{', '.join(map(str, folders))}: no motion of the required subjects.")
    return sequences


def build_sequences(recordings: Iterable[Recording], progress: Callable[[str], object]) -> FrameSequences | None:
    """Return the frames of recordings, without those beyond a rotation jump; None if there are no recordings."""
    is_observed = ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    parts: list[np.ndarray] = []
    names: list[str] = []
    retargeted: set[str] = set()
    source_frames = Counter[RecordingSource]()
    for recording in recordings:
        progress(f"reading {recording.name}")
        kept = find_longest_jump_free_slice(recording.rotations[:, is_observed], recording.rate_hz)
        parts.append(recording.rotations[kept].astype(np.float32))
        names.append(recording.subject)
        source_frames[recording.source] += len(parts[-1])
        if recording.source.is_retargeted:
            retargeted.add(recording.subject)
    if not parts:
        return None
    counts = np.array([len(each) for each in parts])
    subjects, index = np.unique(names, return_inverse=True)
    ends = np.cumsum(counts)
    first, last = np.repeat(ends - counts, counts), np.repeat(ends - 1, counts)
    subject_index, subject_names = np.repeat(index, counts), tuple(map(str, subjects))
    is_retargeted = np.array([name in retargeted for name in subject_names])
    return FrameSequences(np.concatenate(parts), first, last, subject_index, subject_names, is_retargeted, source_frames)


class PairSampler:
    """Draws batches of pairs; the same seed and number of the batch give the same batch."""

    def __init__(self, sequences: FrameSequences, settings: LearnedIkSettings) -> None:
        self.sequences, self.settings = sequences, settings
        names = load_cmu31_body().skeleton.names
        share = np.bincount(sequences.subject_index) / len(sequences.subject_index)
        probability = share ** (1 - settings.subject_balance)
        probability *= np.where(sequences.is_retargeted, settings.retargeted_weight, 1.0)
        self.cumulated = np.cumsum(probability / probability.sum())
        self.frames_of_subject = [np.flatnonzero(sequences.subject_index == i) for i in range(len(sequences.subjects))]
        self.mirrored_joints = [names.index(mirror_joint_name(name)) for name in names]
        self.mean_rotations = load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
        self.limbs = [[names.index(name) for name in BODY_SECTIONS[section]] for section in LIMB_SECTIONS]

    def draw_batch(self, number: int) -> IkBatch:
        """Return a batch of pairs, with noise and missing joints if the settings say so."""
        rng = np.random.default_rng([self.settings.seed, number])
        body = draw_body(rng)
        body = Skeleton(body.names, body.parents, body.offsets * np.exp(SIZE_SD * rng.normal()), body.ends)
        target_frames = self._draw_frames(rng)
        start, target = self._draw_starts(target_frames, rng), self.sequences.rotations[target_frames].astype(float)
        if rng.random() < 0.5:
            start, target = (MIRROR_X_MATRIX @ each[:, self.mirrored_joints] @ MIRROR_X_MATRIX for each in (start, target))
        root = np.zeros((len(target), 3))
        positions, _ = compute_tree_poses(build_kinematic_tree(body), root, target)
        start_root = START_ROOT_SD_M * rng.normal(size=root.shape)
        if not self.settings.has_corruption:
            return IkBatch(body, (start_root, start), (root, target), positions, np.full(positions.shape[:2], EXACT_SD_M[0]))
        given, joint_sd = self._corrupt_positions(positions, rng)
        chosen = np.flatnonzero(rng.random(len(start)) < SECOND_PASS_SHARE)
        tree = build_transfer_tree(body)
        transferred, _ = transfer_poses(tree, (start_root[chosen], start[chosen]), given[chosen], joint_sd[chosen])
        no_corrections = np.zeros((len(chosen), 3 * start.shape[1] + 3), np.float32)
        start_root[chosen], start[chosen] = correct_poses(tree, start[chosen], transferred, no_corrections)
        return IkBatch(body, (start_root, start), (root, target), given, joint_sd)

    def _draw_frames(self, rng: np.random.Generator) -> Int[np.ndarray, " B"]:
        subjects = np.searchsorted(self.cumulated, rng.random(self.settings.batch_poses))
        draws = rng.random(len(subjects))
        frames = [self.frames_of_subject[min(i, len(self.frames_of_subject) - 1)] for i in subjects]
        return np.array([each[int(u * len(each))] for each, u in zip(frames, draws, strict=True)])

    def _draw_starts(self, target_frames: Int[np.ndarray, " B"], rng: np.random.Generator) -> Float[np.ndarray, "B J 3 3"]:
        sequences, count = self.sequences, len(target_frames)
        offset = rng.choice(self.settings.frame_offsets, count)
        kind = rng.random(count) if self.settings.has_corruption else np.ones(count)
        shares = np.cumsum([FAR_START_SHARE, MEAN_POSE_SHARE, OTHER_POSE_SHARE])
        is_far, is_mean, is_other = kind < shares[0], (kind >= shares[0]) & (kind < shares[1]), kind < shares[2]
        is_other &= kind >= shares[1]
        offset = np.where(is_far, rng.integers(10, MAX_FAR_START_FRAMES + 1, count), offset) * rng.choice([-1, 1], count)
        is_outside = (target_frames + offset < sequences.first[target_frames]) | (
            target_frames + offset > sequences.last[target_frames]
        )
        frames = target_frames + np.where(is_outside, -offset, offset)
        frames = np.clip(frames, sequences.first[target_frames], sequences.last[target_frames])
        frames[is_other] = rng.integers(0, len(sequences.rotations), int(is_other.sum()))
        start = sequences.rotations[frames].astype(float)
        start[is_mean] = self.mean_rotations
        is_free = is_mean | is_other
        tilt = Rotation.from_rotvec(START_TILT_SD_RAD * rng.normal(size=(int(is_free.sum()), 3))).as_matrix()
        start[is_free, 0] = tilt @ sequences.rotations[target_frames[is_free], 0]
        if self.settings.has_corruption:
            chosen = np.flatnonzero(rng.random(count) < PERTURBED_SHARE)
            size = MAX_PERTURBATION_RAD * rng.random((len(chosen), 1, 1)) * rng.normal(size=(len(chosen), start.shape[1], 3))
            start[chosen] = start[chosen] @ Rotation.from_rotvec(size.reshape(-1, 3)).as_matrix().reshape(
                -1, start.shape[1], 3, 3
            )
        return start

    def _corrupt_positions(
        self, positions: Float[np.ndarray, "B J 3"], rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "B J 3"], Float[np.ndarray, "B J"]]:
        count, joints = positions.shape[:2]
        is_exact = rng.random((count, 1)) < EXACT_SHARE
        exact_sd, noisy_sd = (
            np.exp(rng.uniform(np.log(low), np.log(high), (count, 1))) for low, high in (EXACT_SD_M, NOISY_SD_M)
        )
        spread = np.exp(JOINT_SD_SPREAD * rng.normal(size=(count, joints)) * (rng.random((count, 1)) < 0.5))
        joint_sd = np.where(is_exact, exact_sd, noisy_sd * spread)
        noise = joint_sd[..., None] * rng.normal(size=positions.shape)
        # Positions that coincide in the skeleton may be one estimate, or several.
        is_shared = rng.random(count) < 0.5
        for joint, twin in find_coincident_joints():
            noise[is_shared, joint] = noise[is_shared, twin]
            joint_sd[is_shared, joint] = joint_sd[is_shared, twin]
        given = positions + noise
        kind = rng.random(count) / MISSING_SHARE
        joint_share = MAX_MISSING_JOINT_SHARE * rng.random((count, 1))
        is_missing = (rng.random((count, joints)) < joint_share) & (kind < 0.5)[:, None]
        lost_share = MEAN_LOST_LIMBS / len(self.limbs)
        for limb in self.limbs:
            lost = (kind >= 0.5) & (kind < 1) & (rng.random(count) < lost_share)
            first = np.minimum((rng.random(count) ** 1.5 * len(limb)).astype(int), len(limb) - 1)
            for i, joint in enumerate(limb):
                is_missing[:, joint] |= lost & (i >= first)
        given[is_missing] = np.nan
        return given, joint_sd


def find_coincident_joints() -> list[tuple[int, int]]:
    """Return joints of the average skeleton that lie where an earlier one does, with that joint."""
    skeleton = load_cmu31_body().skeleton
    places = [(int(parent), *offset) for parent, offset in zip(skeleton.parents, skeleton.offsets.tolist(), strict=True)]
    pairs = [(j, int(skeleton.parents[j])) for j in range(1, len(places)) if not np.any(skeleton.offsets[j])]
    return pairs + [(j, places.index(place)) for j, place in enumerate(places) if places.index(place) < j and any(place[1:])]

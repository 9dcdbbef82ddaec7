"""Jumps in solved motion: CMU's truth has joints that turn over from one frame to the next, and stay so."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.pose_prior.model import compute_pose_vectors
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import recording_folders

# MERGED: mocapfix.train.flips
MAX_JOINT_SPEED_RAD_S = 30.0  # rad/s: no joint of these people turned so fast


def detect_rotation_jumps(rotations: np.ndarray, rate_hz: float) -> np.ndarray:
    """-> (T - 1, ...) bool: whether rotations (T, ..., 3, 3) at `rate` Hz jump from a frame to the next."""
    cosines = (np.einsum("t...ab,t...ab->t...", rotations[1:], rotations[:-1]) - 1) / 2
    return np.arccos(np.clip(cosines, -1, 1)) * rate_hz >= MAX_JOINT_SPEED_RAD_S


def find_longest_jump_free_slice(rotations: np.ndarray, rate_hz: float) -> slice:
    """-> the longest stretch of frames in which none of the joints (T, J, 3, 3) jumps.

    Which side of a jump is right is not to be seen; the longer is the likelier.
    """
    cuts = np.concatenate([[0], np.flatnonzero(detect_rotation_jumps(rotations, rate_hz).any(axis=1)) + 1, [len(rotations)]])
    at = int(np.diff(cuts).argmax())
    return slice(int(cuts[at]), int(cuts[at + 1]))


# MERGED: mocapfix.train.mirror
# The other side: every motion is also somebody's who is mirrored.
MIRROR_X_MATRIX = np.diag([-1.0, 1.0, 1.0])  # left becomes right, x changes sign


def mirror_joint_name(name: str) -> str:
    """-> the joint on the other side: LeftArm for RightArm, LThumb for RThumb."""
    for left, right in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
        if name.startswith(left):
            return right + name[len(left) :]
        if name.startswith(right):
            return left + name[len(right) :]
    return name


def mirror_pose_vectors(pose_vectors: np.ndarray, joint_names: tuple[str, ...]) -> np.ndarray:
    """-> (N, J, 3) the poses in a mirror, of rotation vectors (N, J, 3) from a middle pose that is its own mirror image.

    A turn about x stays as it is, for x is across the mirror; turns about y and z change their sense.
    """
    return pose_vectors[:, [joint_names.index(mirror_joint_name(name)) for name in joint_names]] * np.array(
        [1, -1, -1], pose_vectors.dtype
    )


# MERGED: mocapfix.train.poses
# Poses to learn from: people's motion without place, heading and flips, as it is and mirrored.
# Joints of which the data say little, and whose flips therefore do not matter.
WEAKLY_OBSERVED_JOINTS = ("HipJoint", "FingerBase", "HandIndex1", "Thumb", "ToeBase")


@dataclass(frozen=True)
class TrainingPoses:
    """Rotation vectors from a middle pose, the root's its tilt, in radians, in single precision.

    seen, unseen  (N, J, 3) and (M, J, 3) of the subjects to be learned from and of those kept from it; each pose is there
                  twice, the second half being the first mirrored
    whose         (N,) whose pose each of those seen is: a number for each subject
    frames        subject: how many frames were taken of him, before mirroring; of interleaved ones, to be learned from
    dropped       frames beyond a flip, which were not
    interleaved   whether what is learned from and what is kept are frames of the same takes instead
    """

    training_vectors: np.ndarray
    held_out_vectors: np.ndarray
    subject_index: np.ndarray
    frame_counts: Counter[str]
    dropped_frames: int
    is_interleaved: bool = False


def find_weakly_observed_joints(joint_names: tuple[str, ...]) -> np.ndarray:
    """-> (J,) bool: which joints are slight."""
    return np.array([name.endswith(WEAKLY_OBSERVED_JOINTS) for name in joint_names])


def select_interleaved_frames(frames: int) -> np.ndarray:
    """-> (T,) bool: which frames MNN-IK's own split learns from, three of every five; the others are for its tests (4.1)."""
    return np.arange(frames) % 5 % 2 == 0


def gather_training_poses(
    folder: Path,
    reference_rotations: np.ndarray,
    test_subjects: frozenset[str],
    held_out_subjects: frozenset[str],
    progress: Callable[[str], None],
    is_interleaved: bool = False,
) -> TrainingPoses:
    """-> all poses in a folder, but for the subjects of `test`; or those of everybody, by MNN-IK's own split.

    Raises ReadError where the folder holds no motion of those to be learned from, or none of those who are `unseen`.
    """
    names = load_cmu31_body().skeleton.names
    firm, frames, dropped = ~find_weakly_observed_joints(names), Counter[str](), 0
    found: dict[bool, list[np.ndarray]] = {True: [], False: []}
    whose: list[str] = []
    for recording in recording_folders.read_recordings(folder):
        if recording.subject in test_subjects and not is_interleaved:
            continue
        progress(f"reading {recording.name}")
        kept = find_longest_jump_free_slice(recording.rotations[:, firm], recording.rate_hz)
        vectors = compute_pose_vectors(recording.rotations[kept], reference_rotations).astype(
            np.float32
        )  # for there may be millions
        by_subject = np.full(len(vectors), recording.subject not in held_out_subjects)
        learned = select_interleaved_frames(len(recording.rotations))[kept] if is_interleaved else by_subject
        found[False].append(vectors[learned])
        found[True].append(vectors[~learned])
        whose += [recording.subject] * int(learned.sum())
        frames[recording.subject] += int(learned.sum()) if is_interleaved else len(vectors)
        dropped += len(recording.rotations) - len(vectors)
    for is_unseen, whom in (
        (False, "subjects to learn from"),
        (True, f"the unseen subjects {', '.join(sorted(held_out_subjects))}"),
    ):
        if not any(map(len, found[is_unseen])):
            raise ReadError(f"{folder}: holds no motion of {whom}.")
    both = (np.concatenate(found[is_unseen]) for is_unseen in (False, True))
    seen, kept_back = (np.concatenate([each, mirror_pose_vectors(each, names)]) for each in both)
    return TrainingPoses(seen, kept_back, np.tile(np.unique(whose, return_inverse=True)[1], 2), frames, dropped, is_interleaved)

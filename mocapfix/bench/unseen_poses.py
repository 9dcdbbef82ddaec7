"""True poses for the benchmarks, of subjects that no shipped prior was trained on.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior.model import remove_heading
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.recordings import Recording, read_recordings
from mocapfix.train.training_poses import find_longest_jump_free_slice, find_weakly_observed_joints, select_interleaved_frames

UNSEEN_SUBJECTS = frozenset({"02", "05", "06", "16", "49", "85"})  # `test_subjects` of all settings in priors/
UNSEEN_POSES_FILE = "bench/unseen-poses.npz"  # in scenes/
HALF_TURN_STEPS = 32767  # integer that stands for half a turn in the shipped Euler angles


def load_unseen_poses() -> Float[np.ndarray, "N J 3 3"]:
    """Return the shipped poses, 1000 of them, as local rotations without heading."""
    with np.load(find_shipped_folder("scenes") / UNSEEN_POSES_FILE) as file:
        angles = file["euler"] * (np.pi / HALF_TURN_STEPS)
    return Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape, 3)


def write_unseen_poses(target: Path, poses: Float[np.ndarray, "N J 3 3"]) -> None:
    """Write poses as `load_unseen_poses` reads them: ZYX Euler angles as integers."""
    angles = Rotation.from_matrix(poses.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*poses.shape[:2], 3)
    np.savez_compressed(target, euler=np.round(angles * (HALF_TURN_STEPS / np.pi)).astype(np.int16))


def sample_subject_poses(
    motion_folder: Path, max_poses: int, subjects: frozenset[str] = UNSEEN_SUBJECTS
) -> Float[np.ndarray, "N J 3 3"]:
    """Return poses of some subjects, evenly spaced over all their frames in a folder of motion.

    Raises ReadError if the folder holds no motion of these subjects.
    """

    def select_subjects(recording: Recording, is_kept: np.ndarray) -> np.ndarray:
        return is_kept & (recording.subject in subjects)

    return sample_poses(motion_folder, max_poses, select_subjects)


def sample_interleaved_poses(motion_folder: Path, max_poses: int) -> Float[np.ndarray, "N J 3 3"]:
    """Return poses of all subjects out of the two of every five frames that MNN-IK's split does not train on (4.1)."""
    return sample_poses(motion_folder, max_poses, lambda _, is_kept: is_kept & ~select_interleaved_frames(len(is_kept)))


def sample_poses(
    motion_folder: Path, max_poses: int, select: Callable[[Recording, Bool[np.ndarray, " _"]], Bool[np.ndarray, " _"]]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return at most `max_poses` poses, evenly spaced over the frames that `select` keeps of those without jumps."""
    is_observed = ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    parts: list[np.ndarray] = []
    for recording in read_recordings(motion_folder):
        is_kept = np.zeros(len(recording.rotations), bool)
        is_kept[find_longest_jump_free_slice(recording.rotations[:, is_observed], recording.rate_hz)] = True
        parts.append(recording.rotations[select(recording, is_kept)])
    poses = np.concatenate(parts)
    if not len(poses):
        subjects = ", ".join(sorted(UNSEEN_SUBJECTS))
        raise ReadError(f"{motion_folder}: holds no motion of the test subjects {subjects}.")
    poses = poses[np.linspace(0, len(poses) - 1, min(max_poses, len(poses))).astype(int)]
    poses[:, 0] = remove_heading(poses[:, 0])
    return np.ascontiguousarray(poses)

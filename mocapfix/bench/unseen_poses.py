"""Poses that a benchmark holds for true, of people whom no shipped prior has seen.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior.model import remove_heading
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import recording_folders
from mocapfix.train.shard_recordings import Recording
from mocapfix.train.training_poses import find_longest_jump_free_slice, find_weakly_observed_joints, select_interleaved_frames

UNSEEN_SUBJECTS = frozenset({"02", "05", "06", "16", "49", "85"})  # whom priors/*.yaml leave out as `test`
UNSEEN_POSES_FILE = "bench/unseen-poses.npz"
HALF_TURN_STEPS = 32767  # of the shipped angles: half a turn


def load_unseen_poses() -> np.ndarray:
    """-> (1000, J, 3, 3) local rotations without heading: the poses that travel with mocapfix, as `of_subjects` chose them."""
    with np.load(find_shipped_folder("scenes") / UNSEEN_POSES_FILE) as file:
        angles = file["euler"] * (np.pi / HALF_TURN_STEPS)
    return Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape, 3)


def write_unseen_poses(target: Path, poses: np.ndarray) -> None:
    """Write poses (N, J, 3, 3) as `shipped` reads them: angles about z, y, x, half a turn in 32767 steps."""
    angles = Rotation.from_matrix(poses.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*poses.shape[:2], 3)
    np.savez_compressed(target, euler=np.round(angles * (HALF_TURN_STEPS / np.pi)).astype(np.int16))


def sample_subject_poses(motion_folder: Path, max_poses: int, subjects: frozenset[str] = UNSEEN_SUBJECTS) -> np.ndarray:
    """-> (N, J, 3, 3) poses of some subjects, evenly spread over all their frames in a folder of motion.

    Raises ReadError where the folder holds no motion of them.
    """
    return sample_poses(motion_folder, max_poses, lambda recording, kept: kept if recording.subject in subjects else kept & False)


def sample_interleaved_poses(motion_folder: Path, max_poses: int) -> np.ndarray:
    """-> (N, J, 3, 3) poses of everybody: of every five frames the two that MNN-IK's split does not learn from (4.1)."""
    return sample_poses(motion_folder, max_poses, lambda recording, kept: kept & ~select_interleaved_frames(len(kept)))


def sample_poses(motion_folder: Path, max_poses: int, choose: Callable[[Recording, np.ndarray], np.ndarray]) -> np.ndarray:
    """-> (N, J, 3, 3), N <= count, poses evenly spread over the frames (T,) bool that `choose` keeps; flips are left out."""
    firm, found = ~find_weakly_observed_joints(load_cmu31_body().skeleton.names), []
    for recording in recording_folders.read_recordings(motion_folder):
        kept = np.zeros(len(recording.rotations), bool)
        kept[find_longest_jump_free_slice(recording.rotations[:, firm], recording.rate_hz)] = True
        found.append(recording.rotations[choose(recording, kept)])
    poses = np.concatenate(found)
    if not len(poses):
        raise ReadError(
            f"{motion_folder}: holds no motion of the subjects {', '.join(sorted(UNSEEN_SUBJECTS))}, whom no prior has seen."
        )
    poses = poses[np.linspace(0, len(poses) - 1, min(max_poses, len(poses))).astype(int)]
    poses[:, 0] = remove_heading(poses[:, 0])
    return np.ascontiguousarray(poses)

"""Poses that a benchmark holds for true, of people whom no shipped prior has seen.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.prior.contract import tilt
from mocapfix.scenes import folder
from mocapfix.skeleton import cmu31
from mocapfix.train import recordings
from mocapfix.train.flips import longest_between
from mocapfix.train.poses import learned_between, slight
from mocapfix.train.recordings.recording import Recording

SUBJECTS = frozenset({"02", "05", "06", "16", "49", "85"})  # whom priors/*.yaml leave out as `test`
SHIPPED = "bench/unseen-poses.npz"
FULL = 32767  # of the shipped angles: half a turn


def shipped() -> np.ndarray:
    """-> (1000, J, 3, 3) local rotations without heading: the poses that travel with mocapfix, as `of_subjects` chose them."""
    with np.load(folder("scenes") / SHIPPED) as file:
        angles = file["euler"] * (np.pi / FULL)
    return Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape, 3)


def pack(target: Path, poses: np.ndarray) -> None:
    """Write poses (N, J, 3, 3) as `shipped` reads them: angles about z, y, x, half a turn in 32767 steps."""
    angles = Rotation.from_matrix(poses.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*poses.shape[:2], 3)
    np.savez_compressed(target, euler=np.round(angles * (FULL / np.pi)).astype(np.int16))


def of_subjects(data: Path, count: int, subjects: frozenset[str] = SUBJECTS) -> np.ndarray:
    """-> (N, J, 3, 3) poses of some subjects, evenly spread over all their frames in a folder of motion.

    Raises ReadError where the folder holds no motion of them.
    """
    return spread(data, count, lambda recording, kept: kept if recording.subject in subjects else kept & False)


def between(data: Path, count: int) -> np.ndarray:
    """-> (N, J, 3, 3) poses of everybody: of every five frames the two that MNN-IK's split does not learn from (4.1)."""
    return spread(data, count, lambda recording, kept: kept & ~learned_between(len(kept)))


def spread(data: Path, count: int, choose: Callable[[Recording, np.ndarray], np.ndarray]) -> np.ndarray:
    """-> (N, J, 3, 3), N <= count, poses evenly spread over the frames (T,) bool that `choose` keeps; flips are left out."""
    firm, found = ~slight(cmu31().skeleton.names), []
    for recording in recordings.read(data):
        kept = np.zeros(len(recording.rotations), bool)
        kept[longest_between(recording.rotations[:, firm], recording.rate)] = True
        found.append(recording.rotations[choose(recording, kept)])
    poses = np.concatenate(found)
    if not len(poses):
        raise ReadError(f"{data}: holds no motion of the subjects {', '.join(sorted(SUBJECTS))}, whom no prior has seen.")
    poses = poses[np.linspace(0, len(poses) - 1, min(count, len(poses))).astype(int)]
    poses[:, 0] = tilt(poses[:, 0])
    return np.ascontiguousarray(poses)

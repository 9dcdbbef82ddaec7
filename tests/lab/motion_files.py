"""Files of synthetic motion, for the tests of readers and training."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.io.bvh import write_bvh
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_skeleton


def draw_motion(seed: int, frames: int = 24, spread: float = 0.3) -> np.ndarray:
    """Return the local rotations (T, 31, 3, 3) of a body that bends slowly, depending on the seed. Clavicles do not move."""
    rng = np.random.default_rng(seed)
    is_moving = np.array([name not in ("LeftShoulder", "RightShoulder") for name in load_cmu31_skeleton().names])
    first, last = rng.normal(0, spread, (2, 31, 3)) * is_moving[:, None]
    share = np.linspace(0, 1, frames)[:, None, None]
    vectors = first + share * (last - first)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 31, 3, 3)


def write_bvh_motion(path: Path, rotations: np.ndarray, rate: float = 30.0) -> None:
    frames = len(rotations)
    empty = np.zeros((frames, 0))
    motion = Motion(np.zeros((frames, 3)), rotations, np.zeros(frames, int), np.zeros(frames, int), empty, empty)
    write_bvh(path, load_cmu31_skeleton(), motion, rate)

"""Fit the mean-pose prior: python -m mocapfix.train.mean_pose MOTION_FOLDER priors/mean-pose.yaml

MOTION_FOLDER holds skeletons.json and shards train-*.npz: `euler` int16 (frames, 31, 3), ZYX, 32767 = 180 degrees.
Each motion counts twice, as it is and mirrored, so the mean pose has no handedness. A joint's covariance is that of
the rotation vectors from the mean pose to the poses of all subjects, in the axes of the joint's parent.

CMU's skeleton is a hinge at the knee and the elbow, turns the forearm only at the wrist and holds the clavicle still.
People are not so stiff and markers see it: axes about which its joints never turn are `held`, with a deviation of HELD,
and the elbow is given the forearm's turn.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.train.mirror import FLIP, mirrored_name

NEVER = 0.02  # radians: an axis that turns less than this in all the data is one that the skeleton holds
HELD = 0.2  # radians
FOREARM_TURN = 0.5  # radians
CARD = """\
# The mean pose of people in motion, and how each joint strays from it: covariance of its rotation vectors from the
# mean in its parent's axes, in square radians (xx, yy, zz, xy, xz, yz). About the axes `held` the skeleton does not turn.
# Fitted by mocapfix.train.mean_pose to {frames} frames of {trials} trials of the CMU database, each also mirrored.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def mean_rotation(matrices: np.ndarray) -> np.ndarray:
    """-> the rotation (3, 3) nearest, in the chordal sense, to all of `matrices` (N, 3, 3)."""
    u, _, vt = np.linalg.svd(matrices.mean(0))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def fit(names: list[str], euler: np.ndarray) -> dict:
    """-> the prior's mapping, from joint names and Euler angles (N, J, 3) in degrees, ZYX."""
    matrices = {n: Rotation.from_euler("ZYX", euler[:, j], degrees=True).as_matrix() for j, n in enumerate(names)}
    joints = {}
    for name in names[1:]:
        both = np.concatenate([matrices[name], FLIP @ matrices[mirrored_name(name)] @ FLIP])
        mean = mean_rotation(both)
        quaternion = Rotation.from_matrix(mean).as_quat(canonical=True)
        c, held = covariance(both @ mean.T, turns_along_x=name.endswith("ForeArm"))
        joints[name] = {
            "quaternion_xyzw": [round(float(q), 5) for q in quaternion],
            "covariance": [round(float(v), 5) for v in (c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2])],
            "held": [[round(float(v), 5) for v in axis] for axis in held],
        }
    return joints


def covariance(away: np.ndarray, turns_along_x: bool) -> tuple[np.ndarray, np.ndarray]:
    """-> (3, 3) covariance of the rotation vectors of `away` (N, 3, 3), and the axes (n, 3) that are held.

    turns_along_x  for a forearm: it turns about x, its own axis, though the data have that turn at the wrist
    """
    vectors = Rotation.from_matrix(away).as_rotvec()
    value, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    stiff = value < NEVER**2
    if turns_along_x and stiff.sum() == 2:
        third = np.cross(axes[:, 2], [1.0, 0.0, 0.0])
        axes = np.stack([third / np.linalg.norm(third), np.cross(axes[:, 2], third / np.linalg.norm(third)), axes[:, 2]], 1)
        value, stiff = np.array([HELD**2, FOREARM_TURN**2, value[2]]), np.array([True, False, False])
    value = np.where(stiff, HELD**2, value)
    return (axes * value) @ axes.T, axes[:, stiff].T


def main(folder: str, target: str) -> None:
    names = json.loads((Path(folder) / "skeletons.json").read_text())["joints"]
    shards = [np.load(path) for path in sorted(Path(folder).glob("train-*.npz")) if "approx" not in path.name]
    euler = np.concatenate([shard["euler"] for shard in shards]) / 32767 * 180
    trials = sum(len(shard["trial"]) for shard in shards)
    text = yaml.safe_dump({"joints": fit(names, euler)}, sort_keys=False, default_flow_style=None, width=120)
    Path(target).write_text(CARD.format(frames=len(euler), trials=trials) + text)


if __name__ == "__main__":
    main(*sys.argv[1:])

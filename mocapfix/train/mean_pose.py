"""Fit the mean-pose prior: python -m mocapfix.train.mean_pose MOTION_FOLDER priors/mean-pose.yaml

MOTION_FOLDER holds skeletons.json and shards train-*.npz: `euler` int16 (frames, 31, 3), ZYX, 32767 = 180 degrees.
Each motion counts twice, as it is and mirrored, so the mean pose has no handedness. A joint's covariance is that of
the rotation vectors from the mean pose to the poses of all subjects, in the axes of the joint's parent. How much of it lies
between takes, for each has its own mean pose, is said beside it: a take tells that one only once, however long it is.

CMU's skeleton is a hinge at the knee and the elbow, turns the forearm only at the wrist and holds the clavicle still.
People are not so stiff and markers see it: axes about which its joints never turn are `held`, with a deviation of HELD, or
HINGE where the joint turns about another; and the elbow is given the forearm's turn.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.train.training_poses import MIRROR_X_MATRIX, mirror_joint_name

MAX_LOCKED_AXIS_MOTION_RAD = 0.02  # radians: an axis that turns less than this in all the data is one that the skeleton holds
LOCKED_JOINT_SD_RAD = 0.2  # radians, of a joint that never turns at all: people do shrug
HINGE_CROSS_AXIS_SD_RAD = 0.1  # radians, across a joint's own axes: knees give way by a few degrees
FOREARM_TWIST_SD_RAD = 0.5  # radians
FOREARM_TWIST_BETWEEN_TAKES_SD_RAD = 0.25  # radians: the part of it that lies between takes, as at the wrists
MEAN_POSE_HEADER = """\
# The mean pose of people in motion, and how each joint strays from it: covariance of its rotation vectors from the
# mean in its parent's axes, in square radians (xx, yy, zz, xy, xz, yz); and the part of it that lies between the takes' own
# mean poses. About the axes `held` the skeleton does not turn.
# Fitted by mocapfix.train.mean_pose to {frames} frames of {trials} trials of the CMU database, each also mirrored.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def compute_chordal_mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """-> the rotation (3, 3) nearest, in the chordal sense, to all of `matrices` (N, 3, 3)."""
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def fit_mean_pose(joint_names: list[str], euler_deg: np.ndarray, take_index: np.ndarray) -> dict:
    """-> the prior's mapping, from joint names, Euler angles (N, J, 3) in degrees, ZYX, and which take each is of (N,)."""
    matrices = {n: Rotation.from_euler("ZYX", euler_deg[:, j], degrees=True).as_matrix() for j, n in enumerate(joint_names)}
    joints = {}
    for name in joint_names[1:]:
        both = np.concatenate([matrices[name], MIRROR_X_MATRIX @ matrices[mirror_joint_name(name)] @ MIRROR_X_MATRIX])
        mean = compute_chordal_mean_rotation(both)
        quaternion = Rotation.from_matrix(mean).as_quat(canonical=True)
        away, forearm = both @ mean.T, name.endswith("ForeArm")
        c, held = compute_pose_covariance(away, is_forearm=forearm)
        apart = compute_between_take_covariance(away, np.r_[take_index, take_index + take_index.max() + 1], held)
        if forearm:
            apart[0, 0] = min(FOREARM_TWIST_BETWEEN_TAKES_SD_RAD**2, c[0, 0] / 2)
        joints[name] = {
            "quaternion_xyzw": [round(float(q), 5) for q in quaternion],
            "covariance": pack_symmetric_matrix(c),
            "between": pack_symmetric_matrix(apart),
            "held": [[round(float(v), 5) for v in axis] for axis in held],
        }
    return joints


def pack_symmetric_matrix(matrix: np.ndarray) -> list[float]:
    """-> what a file says of a symmetric matrix (3, 3)."""
    return [round(float(v), 5) for v in (matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[0, 1], matrix[0, 2], matrix[1, 2])]


def compute_between_take_covariance(rotations: np.ndarray, take_index: np.ndarray, locked_axes: np.ndarray) -> np.ndarray:
    """-> (3, 3) covariance of the takes' mean rotation vectors, takes counting by their lengths; nothing about the axes `held`.

    away  (N, 3, 3), takes (N,) the take that each is of
    """
    vectors = Rotation.from_matrix(rotations).as_rotvec() @ (np.eye(3) - locked_axes.T @ locked_axes)
    count = np.bincount(take_index)
    means = np.stack([np.bincount(take_index, vectors[:, a]) for a in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    return (means * count[:, None]).T @ means / len(rotations)


def compute_pose_covariance(rotations: np.ndarray, is_forearm: bool) -> tuple[np.ndarray, np.ndarray]:
    """-> (3, 3) covariance of the rotation vectors of `away` (N, 3, 3), and the axes (n, 3) that are held.

    turns_along_x  for a forearm: it turns about x, its own axis, though the data have that turn at the wrist
    """
    vectors = Rotation.from_matrix(rotations).as_rotvec()
    value, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    stiff = value < MAX_LOCKED_AXIS_MOTION_RAD**2
    if is_forearm and stiff.sum() == 2:
        third = np.cross(axes[:, 2], [1.0, 0.0, 0.0])
        axes = np.stack([third / np.linalg.norm(third), np.cross(axes[:, 2], third / np.linalg.norm(third)), axes[:, 2]], 1)
        value, stiff = np.array([HINGE_CROSS_AXIS_SD_RAD**2, FOREARM_TWIST_SD_RAD**2, value[2]]), np.array([True, False, False])
    value = np.where(stiff, LOCKED_JOINT_SD_RAD**2 if stiff.all() else HINGE_CROSS_AXIS_SD_RAD**2, value)
    return (axes * value) @ axes.T, axes[:, stiff].T


def write_mean_pose(motion_folder: str, target_path: str) -> None:
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text())["joints"]
    shards = [np.load(path) for path in sorted(Path(motion_folder).glob("train-*.npz")) if "approx" not in path.name]
    euler = np.concatenate([shard["euler"] for shard in shards]) / 32767 * 180
    lengths = np.concatenate([shard["length"] for shard in shards])
    joints = fit_mean_pose(names, euler, np.repeat(np.arange(len(lengths)), lengths))
    text = yaml.safe_dump({"joints": joints}, sort_keys=False, default_flow_style=None, width=120)
    Path(target_path).write_text(MEAN_POSE_HEADER.format(frames=len(euler), trials=len(lengths)) + text)


if __name__ == "__main__":
    write_mean_pose(*sys.argv[1:])

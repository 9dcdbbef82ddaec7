"""Fit the mean-pose prior: python -m mocapfix.train.mean_pose MOTION_FOLDER priors/mean-pose.yaml

MOTION_FOLDER holds skeletons.json and shards train-*.npz: `euler` int16 (frames, 31, 3), ZYX, where 32767 is 180 degrees. Each
motion is used twice, as recorded and mirrored, so that the mean pose is symmetric. A joint's covariance is that of the rotation
vectors from the mean pose to the poses of all subjects, in the axes of the joint's parent. The part of it that lies between
takes, each of which has its own mean pose, is given separately: a take observes that part only once, regardless of its length.

In CMU's skeleton knee and elbow are hinges, the forearm rotates only at the wrist, and the clavicle is fixed. Real joints have
some freedom about these axes, and markers show it. Axes about which a joint never rotates are locked: their standard deviation is
LOCKED_JOINT_SD_RAD, or HINGE_CROSS_AXIS_SD_RAD if the joint rotates about another axis. The elbow is given the forearm's twist.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.train.training_poses import MIRROR_X_MATRIX, mirror_joint_name

MAX_LOCKED_AXIS_MOTION_RAD = 0.02  # a root-mean-square rotation below this, over all the data, means that the axis is locked
LOCKED_JOINT_SD_RAD = 0.2  # standard deviation assumed for a joint that never rotates: people do shrug
HINGE_CROSS_AXIS_SD_RAD = 0.1  # standard deviation assumed across the axes of a joint: knees yield by a few degrees
FOREARM_TWIST_SD_RAD = 0.5  # standard deviation assumed for the twist of the forearm
FOREARM_TWIST_BETWEEN_TAKES_SD_RAD = 0.25  # the part of it that lies between takes, as measured at the wrists
MEAN_POSE_HEADER = """\
# The mean pose of people in motion, and the covariance of poses around it: that of each joint's rotation vectors from the mean
# pose in the axes of its parent, in square radians (xx, yy, zz, xy, xz, yz); and the part of it that lies between the mean poses
# of takes. The skeleton does not rotate about the `locked_axes`.
# Fitted by mocapfix.train.mean_pose to {frames} frames of {trials} trials of the CMU database, each also mirrored.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def compute_chordal_mean_rotation(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of least mean squared chordal distance to all rotations."""
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def fit_mean_pose(
    joint_names: list[str], euler_deg: Float[np.ndarray, "N J 3"], take_index: Int[np.ndarray, " N"]
) -> dict[str, dict[str, list[float] | list[list[float]]]]:
    """Return the entries of the prior's file by joint, given ZYX Euler angles and the take of each frame."""
    rotations = {n: Rotation.from_euler("ZYX", euler_deg[:, j], degrees=True).as_matrix() for j, n in enumerate(joint_names)}
    joints: dict[str, dict[str, list[float] | list[list[float]]]] = {}
    for name in joint_names[1:]:
        mirrored = MIRROR_X_MATRIX @ rotations[mirror_joint_name(name)] @ MIRROR_X_MATRIX
        both = np.concatenate([rotations[name], mirrored])
        mean = compute_chordal_mean_rotation(both)
        quaternion = Rotation.from_matrix(mean).as_quat(canonical=True)
        difference, is_forearm = both @ mean.T, name.endswith("ForeArm")
        covariance, locked_axes = compute_pose_covariance(difference, is_forearm=is_forearm)
        both_takes = np.r_[take_index, take_index + take_index.max() + 1]
        between_takes = compute_between_take_covariance(difference, both_takes, locked_axes)
        if is_forearm:
            between_takes[0, 0] = min(FOREARM_TWIST_BETWEEN_TAKES_SD_RAD**2, covariance[0, 0] / 2)
        joints[name] = {
            "quaternion_xyzw": [round(float(q), 5) for q in quaternion],
            "covariance": pack_symmetric_matrix(covariance),
            "between_takes": pack_symmetric_matrix(between_takes),
            "locked_axes": [[round(float(v), 5) for v in axis] for axis in locked_axes],
        }
    return joints


def pack_symmetric_matrix(matrix: Float[np.ndarray, "3 3"]) -> list[float]:
    """Return the rounded entries xx, yy, zz, xy, xz, yz of a symmetric matrix."""
    entries = (matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[0, 1], matrix[0, 2], matrix[1, 2])
    return [round(float(v), 5) for v in entries]


def compute_between_take_covariance(
    rotations: Float[np.ndarray, "N 3 3"], take_index: Int[np.ndarray, " N"], locked_axes: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the takes' mean rotation vectors, weighted by their lengths and without the locked axes.

    rotations  from the mean pose of all takes
    """
    vectors = Rotation.from_matrix(rotations).as_rotvec() @ (np.eye(3) - locked_axes.T @ locked_axes)
    count = np.bincount(take_index)
    means = np.stack([np.bincount(take_index, vectors[:, a]) for a in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    return (means * count[:, None]).T @ means / len(rotations)


def compute_pose_covariance(
    rotations: Float[np.ndarray, "N 3 3"], *, is_forearm: bool
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 3"]]:
    """Return the covariance of the rotation vectors of rotations from the mean pose, and the locked axes.

    is_forearm  whether the joint twists about its own axis x, though the data have that rotation at the wrist
    """
    vectors = Rotation.from_matrix(rotations).as_rotvec()
    variance, axes = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    is_locked = variance < MAX_LOCKED_AXIS_MOTION_RAD**2
    if is_forearm and is_locked.sum() == 2:
        third = np.cross(axes[:, 2], [1.0, 0.0, 0.0])
        axes = np.stack([third / np.linalg.norm(third), np.cross(axes[:, 2], third / np.linalg.norm(third)), axes[:, 2]], 1)
        variance = np.array([HINGE_CROSS_AXIS_SD_RAD**2, FOREARM_TWIST_SD_RAD**2, variance[2]])
        return (axes * variance) @ axes.T, axes[:, :1].T
    variance = np.where(is_locked, LOCKED_JOINT_SD_RAD**2 if is_locked.all() else HINGE_CROSS_AXIS_SD_RAD**2, variance)
    return (axes * variance) @ axes.T, axes[:, is_locked].T


def write_prior_yaml(target_path: str, header: str, content: object) -> None:
    """Write a header of comments and YAML whose innermost lists and mappings take one line."""
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
    Path(target_path).write_text(header + text, encoding="utf-8")


def write_mean_pose(motion_folder: str, target_path: str) -> None:
    """Fit the mean pose to a folder of motion and write the prior's file."""
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text())["joints"]
    shards = [np.load(path) for path in sorted(Path(motion_folder).glob("train-*.npz")) if "approx" not in path.name]
    euler_deg = np.concatenate([shard["euler"] for shard in shards]) / 32767 * 180
    lengths = np.concatenate([shard["length"] for shard in shards])
    joints = fit_mean_pose(names, euler_deg, np.repeat(np.arange(len(lengths)), lengths))
    header = MEAN_POSE_HEADER.format(frames=len(euler_deg), trials=len(lengths))
    write_prior_yaml(target_path, header, {"joints": joints})


if __name__ == "__main__":
    write_mean_pose(*sys.argv[1:])

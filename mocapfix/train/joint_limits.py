"""Measure how far people's joints turn: python -m mocapfix.train.joint_limits MOTION_FOLDER priors/joint-limits.yaml

MOTION_FOLDER is as for mocapfix.train.mean_pose. A joint's limits are, along each axis of its parent, the range of the
rotation vector from the mean pose to the poses of all subjects, each motion as it is and mirrored, but for the outermost
thousandth of the frames on either side; widened by what each of the subjects would have needed, had he been left out. A
trial in which CMU's solve of the joint jumps is left out for that joint.

Axes that CMU's skeleton holds still are not limited by that: people turn there (see mocapfix.train.mean_pose).
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior import mean_pose as prior
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.mean_pose import FOREARM_TWIST_SD_RAD, LOCKED_JOINT_SD_RAD
from mocapfix.train.training_poses import MIRROR_X_MATRIX, detect_rotation_jumps, mirror_joint_name

JOINT_LIMITS_RATE_HZ = 30.0  # Hz, of the motion
EXCLUDED_TAIL_PERCENT = 0.1  # percent of the frames on either side
COVERED_FRAMES_PERCENT = 99.0  # percent of the frames of somebody who was not measured that shall lie within
LOCKED_AXIS_RANGE_SD = 3.0  # deviations: so far a joint may turn about an axis that the skeleton holds
JOINT_LIMITS_HEADER = """\
# How far people's joints turn: the range of each joint's rotation vector from the mean pose (priors/mean-pose.yaml) along
# the axes x, y, z of its parent, in radians. The root turns freely.
# Measured by mocapfix.train.joint_limits on {frames} frames of {trials} trials of the CMU database, each also mirrored,
# but for the outermost {outermost} % on either side and trials in which the joint jumps; widened so that {newcomer} % of the
# frames of every subject would lie within, had he been left out. About axes that CMU's skeleton holds still, +-{reach}
# deviations of the mean pose.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def is_free_of_jumps(rotations: np.ndarray) -> bool:
    """-> whether a joint's local rotations (T, 3, 3) in a trial are free of jumps.

    After a jump CMU's solve may stay flipped to the trial's end, and which side of it is right is not to be seen.
    """
    return not detect_rotation_jumps(rotations, JOINT_LIMITS_RATE_HZ).any()


def compute_locked_axis_range(mean_pose: MeanPosePrior, joint_index: int, is_forearm: bool) -> np.ndarray:
    """-> (3,) radians along the parent's axes: how far people turn a joint about the axes that the skeleton holds."""
    variance = LOCKED_JOINT_SD_RAD**4 * np.diag(
        mean_pose.locked_information[joint_index]
    )  # held is information: its inverse square is HELD's
    return LOCKED_AXIS_RANGE_SD * np.sqrt(variance + (np.array([FOREARM_TWIST_SD_RAD**2, 0, 0]) if is_forearm else 0.0))


def measure_joint_limits(joint_names: list[str], trials: list[np.ndarray], subjects: list[str], mean_pose: MeanPosePrior) -> dict:
    """-> the limits' mapping, from joint names, trials of Euler angles (T, J, 3) in degrees, ZYX, and whose each trial is."""
    turned = [Rotation.from_euler("ZYX", t.reshape(-1, 3), degrees=True).as_matrix().reshape(*t.shape, 3) for t in trials]
    joints = {}
    for j, name in enumerate(joint_names[1:], start=1):
        away = gather_rotation_vectors(
            turned, subjects, j, joint_names.index(mirror_joint_name(name)), mean_pose.mean_rotations[j]
        )
        (low, high), room = (
            compute_percentile_range(np.concatenate(list(away.values()))),
            compute_locked_axis_range(mean_pose, j, name.endswith("ForeArm")),
        )
        wider = compute_newcomer_margin(away)
        joints[name] = {
            "low": [float(v) for v in np.floor(np.round(1e3 * np.minimum(low - wider, -room), 2)) / 1e3],
            "high": [float(v) for v in np.ceil(np.round(1e3 * np.maximum(high + wider, room), 2)) / 1e3],
        }
    return joints


def gather_rotation_vectors(
    rotations: list[np.ndarray], subjects: list[str], joint_index: int, mirrored_joint_index: int, mean_rotation: np.ndarray
) -> dict[str, np.ndarray]:
    """-> person: (N, 3) rotation vectors from the mean (3, 3) to a joint's turns, and to its `other` side's mirrored."""
    found: dict[str, list[np.ndarray]] = {}
    for trial, person in zip(rotations, subjects, strict=True):
        for course in (trial[:, joint_index], MIRROR_X_MATRIX @ trial[:, mirrored_joint_index] @ MIRROR_X_MATRIX):
            if is_free_of_jumps(course):
                found.setdefault(person, []).append(Rotation.from_matrix(course @ mean_rotation.T).as_rotvec())
    return {person: np.concatenate(courses) for person, courses in found.items()}


def compute_percentile_range(rotation_vectors: np.ndarray) -> np.ndarray:
    """-> (2, 3) lowest and highest of rotation vectors (N, 3), but for the outermost."""
    return np.percentile(rotation_vectors, [EXCLUDED_TAIL_PERCENT, 100 - EXCLUDED_TAIL_PERCENT], axis=0)


def compute_newcomer_margin(rotation_vectors: dict[str, np.ndarray]) -> float:
    """-> radians by which the range of all others must be widened for whoever of the people needs it most."""
    widest = 0.0
    for person, mine in rotation_vectors.items():
        others = [theirs for name, theirs in rotation_vectors.items() if name != person]
        if others:
            low, high = compute_percentile_range(np.concatenate(others))
            beyond = np.maximum(low - mine, mine - high).max(axis=1)
            widest = max(widest, float(np.percentile(beyond, COVERED_FRAMES_PERCENT)))
    return widest


def write_joint_limits(motion_folder: str, target_path: str) -> None:
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text())["joints"]
    trials, people = [], []
    for path in sorted(Path(motion_folder).glob("train-*.npz")):
        if "approx" not in path.name:
            shard = np.load(path)
            trials += np.split(shard["euler"] / 32767 * 180, shard["start"][1:])
            people += [str(trial).split("_")[0] for trial in shard["trial"]]
    joints = measure_joint_limits(names, trials, people, prior.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton))
    text = yaml.safe_dump({"joints": joints}, sort_keys=False, default_flow_style=None, width=120)
    frames = sum(len(trial) for trial in trials)
    card = JOINT_LIMITS_HEADER.format(
        frames=frames,
        trials=len(trials),
        outermost=EXCLUDED_TAIL_PERCENT,
        newcomer=f"{COVERED_FRAMES_PERCENT:g}",
        reach=f"{LOCKED_AXIS_RANGE_SD:g}",
    )
    Path(target_path).write_text(card + text)


if __name__ == "__main__":
    write_joint_limits(*sys.argv[1:])

"""Measure joint limits: python -m mocapfix.train.joint_limits MOTION_FOLDER priors/joint-limits.yaml

MOTION_FOLDER is as for mocapfix.train.mean_pose. The limits of a joint are, along each axis of its parent, the range of the
rotation vector from the mean pose to the poses of all subjects. Each motion is used as recorded and mirrored. The outermost
thousandth of the frames on either side is excluded, and the range is widened by what each subject would have needed if the limits
had been measured without them. A trial in which CMU's solve of the joint jumps is not used for that joint.

Axes that are locked in CMU's skeleton have limits that do not depend on the data (see mocapfix.train.mean_pose).
"""

import json
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior.mean_pose import MeanPosePrior, load_mean_pose_prior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.mean_pose import FOREARM_TWIST_SD_RAD, LOCKED_JOINT_SD_RAD, write_prior_yaml
from mocapfix.train.recordings import TRAINING_RATE_HZ
from mocapfix.train.training_poses import MIRROR_X_MATRIX, detect_rotation_jumps, mirror_joint_name

EXCLUDED_TAIL_PERCENT = 0.1  # of the frames on either side
COVERED_FRAMES_PERCENT = 99.0  # of the frames of a subject who was not measured that shall be within the limits
LOCKED_AXIS_RANGE_SD = 3.0  # limits about a locked axis, in standard deviations of the mean pose
JOINT_LIMITS_HEADER = """\
# Joint limits: the range of each joint's rotation vector from the mean pose (priors/mean-pose.yaml) along the axes x, y, z
# of its parent, in radians. The root has no limits.
# Measured by mocapfix.train.joint_limits on {frames} frames of {trials} trials of the CMU database, each also mirrored, without
# the outermost {tail} % on either side and trials in which the joint jumps; widened so that {covered} % of the frames of every
# subject would be within limits that were measured without that subject. About axes that are locked in CMU's skeleton: +-{range}
# standard deviations of the mean pose.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def is_free_of_jumps(rotations: Float[np.ndarray, "T 3 3"]) -> bool:
    """Return whether a joint's local rotations in a trial have no jumps.

    After a jump CMU's solve may remain flipped to the end of the trial, and the data do not show which side is correct.
    """
    return not detect_rotation_jumps(rotations[:, None], TRAINING_RATE_HZ).any()


def compute_locked_axis_range(mean_pose: MeanPosePrior, joint_index: int, *, is_forearm: bool) -> Float[np.ndarray, "3"]:
    """Return the limits in radians about locked axes, along the axes of the joint's parent; zero about the other axes."""
    # locked_information is the inverse of the locked variance
    variance = LOCKED_JOINT_SD_RAD**4 * np.diag(mean_pose.locked_information[joint_index])
    return LOCKED_AXIS_RANGE_SD * np.sqrt(variance + (np.array([FOREARM_TWIST_SD_RAD**2, 0, 0]) if is_forearm else 0.0))


def measure_joint_limits(
    joint_names: list[str], trials: list[Float[np.ndarray, "_ J 3"]], subjects: list[str], mean_pose: MeanPosePrior
) -> dict[str, dict[str, list[float]]]:
    """Return the low and high limits by joint, given trials of ZYX Euler angles in degrees and the subject of each trial."""
    rotations = [
        Rotation.from_euler("ZYX", trial.reshape(-1, 3), degrees=True).as_matrix().reshape(*trial.shape, 3) for trial in trials
    ]
    limits: dict[str, dict[str, list[float]]] = {}
    for j, name in enumerate(joint_names[1:], start=1):
        mirrored_index = joint_names.index(mirror_joint_name(name))
        vectors = gather_rotation_vectors(rotations, subjects, j, mirrored_index, mean_pose.mean_rotations[j])
        low, high = compute_percentile_range(np.concatenate(list(vectors.values())))
        locked_range = compute_locked_axis_range(mean_pose, j, is_forearm=name.endswith("ForeArm"))
        margin = compute_newcomer_margin(vectors)
        limits[name] = {
            "low": [float(v) for v in np.floor(np.round(1e3 * np.minimum(low - margin, -locked_range), 2)) / 1e3],
            "high": [float(v) for v in np.ceil(np.round(1e3 * np.maximum(high + margin, locked_range), 2)) / 1e3],
        }
    return limits


def gather_rotation_vectors(
    rotations: list[Float[np.ndarray, "_ J 3 3"]],
    subjects: list[str],
    joint_index: int,
    mirrored_joint_index: int,
    mean_rotation: Float[np.ndarray, "3 3"],
) -> dict[str, Float[np.ndarray, "_ 3"]]:
    """Return by subject the rotation vectors from the mean to a joint's rotations, and to the mirrored ones of the other side."""
    vectors: dict[str, list[np.ndarray]] = {}
    for trial, subject in zip(rotations, subjects, strict=True):
        mirrored = MIRROR_X_MATRIX @ trial[:, mirrored_joint_index] @ MIRROR_X_MATRIX
        for joint_rotations in (trial[:, joint_index], mirrored):
            if is_free_of_jumps(joint_rotations):
                difference = Rotation.from_matrix(joint_rotations @ mean_rotation.T)
                vectors.setdefault(subject, []).append(difference.as_rotvec())
    return {subject: np.concatenate(parts) for subject, parts in vectors.items()}


def compute_percentile_range(rotation_vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "2 3"]:
    """Return the minimum and maximum of rotation vectors without the excluded tails."""
    return np.percentile(rotation_vectors, [EXCLUDED_TAIL_PERCENT, 100 - EXCLUDED_TAIL_PERCENT], axis=0)


def compute_newcomer_margin(rotation_vectors: dict[str, Float[np.ndarray, "_ 3"]]) -> float:
    """Return the angle in radians by which the range of the other subjects must be widened for the subject who needs it most."""
    margin = 0.0
    for subject, own in rotation_vectors.items():
        others = [vectors for name, vectors in rotation_vectors.items() if name != subject]
        if others:
            low, high = compute_percentile_range(np.concatenate(others))
            excess = np.maximum(low - own, own - high).max(axis=1)
            margin = max(margin, float(np.percentile(excess, COVERED_FRAMES_PERCENT)))
    return margin


def write_joint_limits(motion_folder: str, target_path: str) -> None:
    """Measure joint limits on a folder of motion and write their file."""
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text())["joints"]
    trials: list[np.ndarray] = []
    subjects: list[str] = []
    for path in sorted(Path(motion_folder).glob("train-*.npz")):
        if "approx" not in path.name:
            shard = np.load(path)
            trials += np.split(shard["euler"] / 32767 * 180, shard["start"][1:])
            subjects += [str(trial).split("_")[0] for trial in shard["trial"]]
    limits = measure_joint_limits(names, trials, subjects, load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton))
    header = JOINT_LIMITS_HEADER.format(
        frames=sum(len(trial) for trial in trials),
        trials=len(trials),
        tail=EXCLUDED_TAIL_PERCENT,
        covered=f"{COVERED_FRAMES_PERCENT:g}",
        range=f"{LOCKED_AXIS_RANGE_SD:g}",
    )
    write_prior_yaml(target_path, header, {"joints": limits})


if __name__ == "__main__":
    write_joint_limits(*sys.argv[1:])

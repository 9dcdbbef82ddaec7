"""Fit mean pose, shape components and joint limits: python -m mocapfix.lab.body_statistics MOTION_FOLDER priors/NAME.yaml

NAME is mean-pose, shape or joint-limits. MOTION_FOLDER holds skeletons.json, whose `offsets_asf` are the joint offsets of each
subject, and shards train-*.npz: `euler` int16 (frames, 31, 3), ZYX, where 32767 is 180 degrees. Each motion and each body is used
twice, as recorded and mirrored.

Mean pose: a joint's covariance is that of the rotation vectors from the mean pose to the poses of all subjects, in the axes of
the joint's parent. The part of it that lies between takes is given separately: a take observes that part only once. In CMU's
skeleton knee and elbow are hinges, the forearm rotates only at the wrist, and the clavicle is fixed. Axes about which a joint
never rotates are locked: their standard deviation is LOCKED_JOINT_SD_RAD, or HINGE_CROSS_AXIS_SD_RAD if the joint rotates about
another axis. The elbow is given the forearm's twist.

Shape: principal components of the bodies of BODY_SUBJECTS, scaled to the size of the average body (SCOPE's Eqs. 60-64).

Joint limits: along each axis of its parent, the range of the rotation vector from the mean pose, without the outermost thousandth
of the frames on either side, and widened by what each subject would have needed if the limits had been measured without them. A
trial in which CMU's solve of the joint jumps is not used for that joint.
"""

import json
import sys
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.lab.recordings import TRAINING_RATE_HZ
from mocapfix.lab.training_poses import MIRROR_X_MATRIX, detect_rotation_jumps, mirror_joint_name
from mocapfix.model.skeleton import load_cmu31_body, load_cmu31_skeleton
from mocapfix.solve.mean_pose import MeanPosePrior, load_mean_pose_prior

MAX_LOCKED_AXIS_MOTION_RAD = 0.02  # a root-mean-square rotation below this, over all the data, means that the axis is locked
LOCKED_JOINT_SD_RAD = 0.2  # standard deviation assumed for a joint that never rotates: people do shrug
HINGE_CROSS_AXIS_SD_RAD = 0.1  # standard deviation assumed across the axes of a joint: knees yield by a few degrees
FOREARM_TWIST_SD_RAD = 0.5  # standard deviation assumed for the twist of the forearm
FOREARM_TWIST_BETWEEN_TAKES_SD_RAD = 0.25  # the part of it that lies between takes, as measured at the wrists
MEAN_POSE_HEADER = """\
# The mean pose of people in motion, and the covariance of poses around it: that of each joint's rotation vectors from the mean
# pose in the axes of its parent, in square radians (xx, yy, zz, xy, xz, yz); and the part of it that lies between the mean poses
# of takes. The skeleton does not rotate about the `locked_axes`.
# Fitted by mocapfix.lab.body_statistics to {frames} frames of {trials} trials of the CMU database, each also mirrored.
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

    Args:
        rotations: From the mean pose of all takes.
    """
    vectors = Rotation.from_matrix(rotations).as_rotvec() @ (np.eye(3) - locked_axes.T @ locked_axes)
    count = np.bincount(take_index)
    means = np.stack([np.bincount(take_index, vectors[:, a]) for a in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    return (means * count[:, None]).T @ means / len(rotations)


def compute_pose_covariance(
    rotations: Float[np.ndarray, "N 3 3"], *, is_forearm: bool
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 3"]]:
    """Return the covariance of the rotation vectors of rotations from the mean pose, and the locked axes.

    Args:
        is_forearm: Whether the joint twists about its own axis x, though the data have that rotation at the wrist.
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
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text(encoding="utf-8"))["joints"]
    shards = [np.load(path) for path in sorted(Path(motion_folder).glob("train-*.npz")) if "approx" not in path.name]
    euler_deg = np.concatenate([shard["euler"] for shard in shards]) / 32767 * 180
    lengths = np.concatenate([shard["length"] for shard in shards])
    joints = fit_mean_pose(names, euler_deg, np.repeat(np.arange(len(lengths)), lengths))
    header = MEAN_POSE_HEADER.format(frames=len(euler_deg), trials=len(lengths))
    write_prior_yaml(target_path, header, {"joints": joints})


BODY_SUBJECTS = ("01", "03", "07", "11", "127", "14", "17", "29", "35")
MAX_SHAPE_COMPONENTS = 10
MIN_WRITTEN_OFFSET_M = 5e-6  # a smaller offset is rounded to zero and not written
SHAPE_HEADER = """\
# Shape components of bodies: principal components of the 31 joints' offsets from those of the average body, at equal size,
# the largest first. Each is one standard deviation, in metres in the axes of the joint's parent; joints with zero offset
# are not listed. These {components} together explain {explained:.0%} of the variance.
#
# Fitted by mocapfix.lab.body_statistics to only {subjects} subjects of the CMU database and their mirror images: the components
# describe the largest differences between these few subjects, and other bodies may differ in other ways.
#
# The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
# EIA-0196217.
"""


def fit_shape_components(
    body_offsets: Float[np.ndarray, "N J 3"],
    mean_offsets: Float[np.ndarray, "J 3"],
    mirrored_index: list[int],
    max_components: int,
) -> tuple[Float[np.ndarray, "P J 3"], float]:
    """Return the shape components, each one standard deviation in metres, and the share of the variance that they explain.

    Args:
        body_offsets: Offsets of the joints of N bodies.
        mean_offsets: Offsets of the average body.
        mirrored_index: (J,) the joint on the other side.
    """
    sizes = np.einsum("nja,ja->n", body_offsets, mean_offsets) / (mean_offsets**2).sum()
    differences = body_offsets / sizes[:, None, None] - mean_offsets
    both = np.concatenate([differences, differences[:, mirrored_index] * [-1.0, 1.0, 1.0]])
    _, values, components = np.linalg.svd(both.reshape(len(both), -1), full_matrices=False)
    count = min(max_components, int((values > 1e-6 * values[0]).sum()))
    scaled = values[:count, None] / np.sqrt(len(both)) * components[:count]
    signs = np.sign(scaled[np.arange(count), np.abs(scaled).argmax(1)])
    explained = float((values[:count] ** 2).sum() / (values**2).sum())
    return (signs[:, None] * scaled).reshape(count, *mean_offsets.shape), explained


def write_shape_components(motion_folder: str, target_path: str) -> None:
    """Fit shape components to the bodies in a folder of motion and write their file."""
    data, skeleton = json.loads((Path(motion_folder) / "skeletons.json").read_text(encoding="utf-8")), load_cmu31_skeleton()
    offsets = [data["skeletons"][subject]["offsets_asf"] for subject in BODY_SUBJECTS]
    mirrored_index = [skeleton.find_joint(mirror_joint_name(name)) for name in skeleton.names]
    body_offsets = data["unit_to_metres"] * np.array(offsets)
    components, explained = fit_shape_components(body_offsets, skeleton.offsets, mirrored_index, MAX_SHAPE_COMPONENTS)
    rounded = [
        {
            name: [round(float(v), 5) + 0.0 for v in offset]
            for name, offset in zip(skeleton.names, component, strict=True)
            if np.abs(offset).max() >= MIN_WRITTEN_OFFSET_M
        }
        for component in components
    ]
    header = SHAPE_HEADER.format(components=len(components), explained=explained, subjects=len(BODY_SUBJECTS))
    write_prior_yaml(target_path, header, {"components": rounded})


EXCLUDED_TAIL_PERCENT = 0.1  # of the frames on either side
COVERED_FRAMES_PERCENT = 99.0  # of the frames of a subject who was not measured that shall be within the limits
LOCKED_AXIS_RANGE_SD = 3.0  # limits about a locked axis, in standard deviations of the mean pose
JOINT_LIMITS_HEADER = """\
# Joint limits: the range of each joint's rotation vector from the mean pose (priors/mean-pose.yaml) along the axes x, y, z
# of its parent, in radians. The root has no limits.
# Measured by mocapfix.lab.body_statistics on {frames} frames of {trials} trials of the CMU database, each also mirrored, without
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
    names = json.loads((Path(motion_folder) / "skeletons.json").read_text(encoding="utf-8"))["joints"]
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


PRIOR_WRITERS = {"mean-pose": write_mean_pose, "shape": write_shape_components, "joint-limits": write_joint_limits}

if __name__ == "__main__":
    PRIOR_WRITERS[Path(sys.argv[2]).stem](*sys.argv[1:])

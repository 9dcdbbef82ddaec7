"""The common task: a take with known truth, on which solvers of poses are timed and compared.

scenes/bench/common-task.yaml says all of it; the random numbers are NumPy's of a fixed seed, so it is the same everywhere.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.files.shipped import read_shipped_yaml
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject


@dataclass(frozen=True)
class CommonTask:
    """What a solver is given, and the truth.

    subject    the body, its joints and M markers as they truly are
    rate       Hz
    mean       (J, 3) radians: the mean pose, each joint's angles about z, y, x
    pull       metres per radian: what straying from the mean pose costs, beside a marker's metre
    takes      name: markers (T, M, 3) in metres, NaN = not seen; "clean" and "noisy"
    starts     name: (T, 3) metres: where a frame that starts from the mean pose, not from its neighbour, has its root
    positions  (T, J, 3) metres: where the joints truly are
    """

    subject: Subject
    rate_hz: float
    mean_angles: np.ndarray
    mean_pose_weight: float
    takes: dict[str, np.ndarray]
    root_starts: dict[str, np.ndarray]
    joint_positions: np.ndarray

    def compute_joint_error(self, root: np.ndarray, rotations: np.ndarray) -> float:
        """-> mean distance of the joints from the truth, metres, over the frames solved: root (T, 3), rotations (T, J, 3, 3)."""
        found = kinematics.compute_world_poses(self.subject.skeleton, build_pose_motion(root, rotations))[0]
        return float(np.linalg.norm(found - self.joint_positions[: len(root)], axis=-1).mean())


def build_common_task() -> CommonTask:
    """-> the task as its scene says."""
    scene = read_shipped_yaml("bench/common-task.yaml")
    rng = np.random.default_rng(scene["seed"])
    subject, mean = build_task_subject(scene), np.array([joint.get("mean", [0.0] * 3) for joint in scene["joints"]])
    seconds = np.arange(scene["frames"]) / scene["rate"]
    root = np.stack([about + swing * np.sin(2 * np.pi * hz * seconds) for about, swing, hz in scene["way"]], axis=1)
    truth = build_pose_motion(root, compute_zyx_rotations(generate_joint_angles(scene, mean, seconds, rng)))
    positions, clean = kinematics.compute_joint_and_marker_positions(subject, truth)
    takes = {"clean": clean, "noisy": corrupt_markers(scene, clean, rng)}
    rest = compute_zyx_rotations(mean)[None]
    placed = kinematics.compute_joint_and_marker_positions(subject, build_pose_motion(np.zeros((1, 3)), rest))[1][0]
    pelvis = [subject.labels.index(label) for label in scene["start"]]
    starts = {name: np.nanmean(markers[:, pelvis] - placed[pelvis], axis=1) for name, markers in takes.items()}
    return CommonTask(subject, scene["rate"], mean, scene["pull"], takes, starts, positions)


def build_task_subject(scene: dict) -> Subject:
    """-> the scene's joints and markers."""
    joints, markers = scene["joints"], scene["markers"]
    names = tuple(joint["name"] for joint in joints)
    parents = np.array([names.index(joint["parent"]) if joint["parent"] else -1 for joint in joints])
    offsets = np.array([joint["offset"] for joint in joints])
    places = np.array([marker["place"] for marker in markers])
    on = np.array([names.index(marker["joint"]) for marker in markers])
    skeleton = Skeleton(names, parents, offsets, np.full_like(offsets, np.nan))
    return Subject(skeleton, "", tuple(marker["label"] for marker in markers), on, places, np.zeros(len(on)))


def generate_joint_angles(scene: dict, mean_angles: np.ndarray, times_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """-> (T, J, 3) radians: every joint's angles about z, y, x at every moment."""
    swing, angles = np.array([joint["swing"] for joint in scene["joints"]]), np.zeros((len(times_s), *mean_angles.shape))
    for band in scene["bands"]:
        hertz, phase = rng.uniform(band["from"], band["to"], swing.shape), rng.uniform(0, 2 * np.pi, swing.shape)
        angles += band["part"] * swing * np.sin(2 * np.pi * hertz * times_s[:, None, None] + phase)
    angles += mean_angles
    knees = [j for j, joint in enumerate(scene["joints"]) if joint["name"] in scene["unbending"]]
    angles[:, knees, 2] = np.maximum(angles[:, knees, 2], 0.0)
    return angles


def corrupt_markers(scene: dict, clean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """-> the clean take (T, M, 3) with noise, and a part of its samples lost in runs."""
    frames, count = clean.shape[:2]
    lost, run = np.zeros((frames, count), bool), round(scene["missing"]["seconds"] * scene["rate"])
    while lost.sum() < int(scene["missing"]["part"] * lost.size):
        marker, first = rng.integers(count), rng.integers(frames - run)
        lost[first : first + run, marker] = True
    noisy = clean + rng.normal(0, scene["noise"], clean.shape)
    noisy[lost] = np.nan
    return noisy


def compute_zyx_rotations(angles: np.ndarray) -> np.ndarray:
    """-> rotations Rz Ry Rx (..., 3, 3) of angles (..., 3) about z, y, x.

    Written out, for the peer turns 31 joints at a time: several times as fast as scipy's Rotation for so few.
    """
    (cz, cy, cx), (sz, sy, sx) = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def build_pose_motion(root: np.ndarray, rotations: np.ndarray) -> Motion:
    """-> poses root (T, 3), rotations (T, J, 3, 3) as a motion of which nothing else is known."""
    nothing = np.zeros(len(root), int)
    return Motion(root, rotations, nothing, nothing, np.zeros((len(root), 0)), np.zeros((len(root), 0)))

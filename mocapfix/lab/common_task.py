"""The common task: a take with known truth, on which pose solvers are timed and compared.

It is defined by scenes/bench/common-task.yaml and a fixed seed of NumPy's random numbers, and so the same on every machine.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from mocapfix import pipeline
from mocapfix.io.shipped import read_yaml
from mocapfix.lab.sound_takes import build_known_motion, find_bench_file
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.options import CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.solve import kinematics
from mocapfix.synthetic import SyntheticTake, write_synthetic_take

DEFAULT_BENCH_OPTIONS = CleanOptions()


@dataclass(frozen=True)
class CommonTask:
    """The input of a solver and the truth."""

    subject: Subject  # the true body and its M markers
    rate_hz: float
    mean_angles: np.ndarray  # (J, 3) radians: Euler angles z, y, x of the mean pose
    mean_pose_weight: float  # metres per radian: a deviation from the mean pose costs as much as this marker residual
    takes: dict[str, np.ndarray]  # "clean" and "noisy": markers (T, M, 3) in metres, NaN where missing
    # by take: (T, 3) metres, root position of a frame that is started from the mean pose, not from its neighbour
    root_starts: dict[str, np.ndarray]
    joint_positions: np.ndarray  # (T, J, 3) metres: the truth

    def compute_joint_error(self, root: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T J 3 3"]) -> float:
        """Return the mean distance of the joints from the truth in metres over the first T frames."""
        positions = kinematics.compute_world_poses(self.subject.skeleton, build_known_motion(root, rotations))[0]
        return float(np.linalg.norm(positions - self.joint_positions[: len(root)], axis=-1).mean())


def build_common_task() -> CommonTask:
    """Return the task that the scene file defines."""
    scene = read_yaml(find_bench_file("common-task.yaml"))
    rng = np.random.default_rng(scene["seed"])
    subject = build_task_subject(scene)
    mean_angles = np.array([joint.get("mean", [0.0] * 3) for joint in scene["joints"]])
    times_s = np.arange(scene["frames"]) / scene["rate"]
    root = np.stack([mean + swing * np.sin(2 * np.pi * hz * times_s) for mean, swing, hz in scene["root"]], axis=1)
    truth = build_known_motion(root, compute_zyx_rotations(generate_joint_angles(scene, mean_angles, times_s, rng)))
    joint_positions, clean = kinematics.compute_joint_and_marker_positions(subject, truth)
    takes = {"clean": clean, "noisy": corrupt_markers(scene, clean, rng)}
    mean_pose = build_known_motion(np.zeros((1, 3)), compute_zyx_rotations(mean_angles)[None])
    mean_markers = kinematics.compute_joint_and_marker_positions(subject, mean_pose)[1][0]
    pelvis = [subject.labels.index(label) for label in scene["start"]]
    starts = {name: np.nanmean(markers[:, pelvis] - mean_markers[pelvis], axis=1) for name, markers in takes.items()}
    return CommonTask(subject, scene["rate"], mean_angles, scene["mean_pose_weight"], takes, starts, joint_positions)


def build_task_subject(scene: dict[str, Any]) -> Subject:
    """Return the scene's joints and markers."""
    joints, markers = scene["joints"], scene["markers"]
    names = tuple(joint["name"] for joint in joints)
    parents = np.array([names.index(joint["parent"]) if joint["parent"] else -1 for joint in joints])
    offsets = np.array([joint["offset"] for joint in joints])
    marker_offsets = np.array([marker["offset"] for marker in markers])
    marker_joints = np.array([names.index(marker["joint"]) for marker in markers])
    skeleton = Skeleton(names, parents, offsets, np.full_like(offsets, np.nan))
    labels = tuple(marker["label"] for marker in markers)
    return Subject(skeleton, "", labels, marker_joints, marker_offsets, np.zeros(len(marker_joints)))


def generate_joint_angles(
    scene: dict[str, Any], mean_angles: Float[np.ndarray, "J 3"], times_s: Float[np.ndarray, " T"], rng: np.random.Generator
) -> Float[np.ndarray, "T J 3"]:
    """Return the Euler angles z, y, x of every joint in radians: sums of sines of random frequency and phase."""
    swing = np.array([joint["swing"] for joint in scene["joints"]])
    angles = np.zeros((len(times_s), *mean_angles.shape))
    for band in scene["bands"]:
        frequency_hz = rng.uniform(band["from"], band["to"], swing.shape)
        phase = rng.uniform(0, 2 * np.pi, swing.shape)
        angles += band["share"] * swing * np.sin(2 * np.pi * frequency_hz * times_s[:, None, None] + phase)
    angles += mean_angles
    knees = [j for j, joint in enumerate(scene["joints"]) if joint["name"] in scene["knees"]]
    angles[:, knees, 2] = np.maximum(angles[:, knees, 2], 0.0)
    return angles


def corrupt_markers(
    scene: dict[str, Any], clean: Float[np.ndarray, "T M 3"], rng: np.random.Generator
) -> Float[np.ndarray, "T M 3"]:
    """Return the clean take with noise and gaps."""
    frame_count, marker_count = clean.shape[:2]
    is_missing = np.zeros((frame_count, marker_count), bool)
    gap_length = round(scene["missing"]["seconds"] * scene["rate"])
    while is_missing.sum() < int(scene["missing"]["share"] * is_missing.size):
        marker, first = rng.integers(marker_count), rng.integers(frame_count - gap_length)
        is_missing[first : first + gap_length, marker] = True
    noisy = clean + rng.normal(0, scene["noise"], clean.shape)
    noisy[is_missing] = np.nan
    return noisy


def compute_zyx_rotations(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotations Rz Ry Rx of Euler angles z, y, x in radians.

    This is several times as fast as scipy's Rotation for the 31 joints of one frame, which the scipy solver needs.
    """
    (cz, cy, cx), (sz, sy, sx) = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def clean_composed_take(truth: SyntheticTake, options: CleanOptions = DEFAULT_BENCH_OPTIONS) -> CleaningResult:
    """Return the result of the pipeline for a composed take, which is written to a file and read."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "take.c3d"
        write_synthetic_take(path, truth)
        return pipeline.clean(path, options)

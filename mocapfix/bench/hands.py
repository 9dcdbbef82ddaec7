"""MNN-IK's application to optical capture (5.1) on real takes: a hand with one marker left, and crossing hands with noise.

A sound capture is damaged for a while and cleaned, with the subject calibrated on the sound capture. The result is compared with
that of the sound capture, and with numerical inverse kinematics from the damaged markers only.
"""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

import mocapfix
from mocapfix import write
from mocapfix.bench.compared_priors import place_solved_poses, solve_without_prior
from mocapfix.errors import TakeError
from mocapfix.kernels.terms import PointTerm
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.read import capture
from mocapfix.result import CleaningResult
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

DAMAGE_DURATION_S = 2.0
HAND_NOISE_SD_M = 0.03  # per axis, independent in every frame
HAND_MARKER_SD_M = 0.01  # standard deviation of a marker that inverse kinematics assumes


class HandDamage(NamedTuple):
    """Damage to a sound take around one frame."""

    labels: tuple[str, ...]  # damaged markers
    joints: tuple[str, ...]  # joints whose error is measured
    find_frame: Callable[[Take], int]
    damage_markers: Callable[[np.ndarray], np.ndarray]  # of markers (T, K, 3)


class HandComparison(NamedTuple):
    """The frame in the middle of the damage: joints (J, 3) and markers (M, 3) in metres, NaN where missing."""

    skeleton: Skeleton
    measured_joints: list[int]
    is_damaged: np.ndarray  # (M,) bool
    damaged_markers: np.ndarray
    cleaned_markers: np.ndarray
    captured_markers: np.ndarray
    markers_only_joints: np.ndarray  # from the damaged markers of this frame only
    cleaned_joints: np.ndarray  # from the cleaned take
    true_joints: np.ndarray  # from the sound take, cleaned
    markers_only_mm: float  # mean error of the measured joints over all damaged frames
    cleaned_mm: float


def find_highest_hand_frame(take: Take) -> int:
    """Return the frame in which the right hand is highest."""
    return int(np.nanargmax(get_hand_marker(take, "RFIN")[:, 1]))


def find_nearest_hands_frame(take: Take) -> int:
    """Return the frame in which the hands are closest to each other."""
    return int(np.nanargmin(np.linalg.norm(get_hand_marker(take, "LFIN") - get_hand_marker(take, "RFIN"), axis=1)))


def get_hand_marker(take: Take, label: str) -> Float[np.ndarray, "T 3"]:
    """Return the positions of a marker in metres. Raises TakeError if the take has no such marker or it is never visible."""
    marker = take.markers[:, find_marker_column(take, label)]
    if np.isnan(marker).any(axis=1).all():
        raise TakeError(f"{take.name}: the marker {label} is never visible; give a take in which it is.")
    return marker


def find_marker_column(take: Take, label: str) -> int:
    """Return the index of the marker with a label. Raises TakeError if there is none."""
    if label not in take.bare_labels:
        raise TakeError(f"{take.name}: has no marker {label}; give a take in CMU's 41 markers.")
    return take.bare_labels.index(label)


def remove_samples(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K 3"]:
    """Return the markers with all samples missing."""
    return np.full_like(markers, np.nan)


def add_noise(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K 3"]:
    """Return the markers with noise."""
    return markers + np.random.default_rng(0).normal(0, HAND_NOISE_SD_M, markers.shape)


RIGHT_HAND_JOINTS = ("RightForeArm", "RightHand", "RightFingerBase")
LEFT_HAND_JOINTS = ("LeftForeArm", "LeftHand", "LeftFingerBase")
# RFIN remains on the right hand.
ONE_MARKER_DAMAGE = HandDamage(("RFRM", "RWRA", "RWRB"), RIGHT_HAND_JOINTS, find_highest_hand_frame, remove_samples)
CROSSED_HANDS_DAMAGE = HandDamage(
    tuple(side + name for side in "LR" for name in ("FRM", "WRA", "WRB", "FIN")),
    LEFT_HAND_JOINTS + RIGHT_HAND_JOINTS,
    find_nearest_hands_frame,
    add_noise,
)


def compare_hands(path: Path, damage: HandDamage) -> HandComparison:
    """Return the comparison of a damaged capture with the sound one.

    Raises ReadError if the file cannot be read, TakeError if markers are missing or no body could be solved.
    """
    take, sound = capture.read_take(path), mocapfix.clean(path)
    middle, half = damage.find_frame(take), round(DAMAGE_DURATION_S / 2 * take.rate)
    columns = [find_marker_column(take, label) for label in damage.labels]
    damaged_frames, markers = slice(max(middle - half, 0), middle + half), take.markers.copy()
    markers[damaged_frames, columns] = damage.damage_markers(markers[damaged_frames, columns])
    with TemporaryDirectory() as folder:
        damaged_path = Path(folder) / path.name
        write.patch_c3d(damaged_path, take, take.replace_markers(markers))
        result = mocapfix.clean(damaged_path, subject=sound.subject)
    subject, motion = result.subject, result.motion
    cleaned, true = result.joint_position_world, sound.joint_position_world
    if subject is None or motion is None or cleaned is None or true is None:
        raise TakeError(f"{take.name}: no body could be solved; give a take in CMU's 41 markers.")
    frames = np.arange(len(markers))[damaged_frames]
    markers_only = solve_markers_only(result, subject, motion, frames)
    cleaned, true = cleaned[damaged_frames], true[damaged_frames]
    joints, row = [subject.skeleton.find_joint(name) for name in damage.joints], int(np.flatnonzero(frames == middle)[0])
    markers_only_mm, cleaned_mm = (
        1e3 * float(np.linalg.norm(each - true, axis=2)[:, joints].mean()) for each in (markers_only, cleaned)
    )
    return HandComparison(
        subject.skeleton,
        joints,
        is_damaged=np.isin(np.arange(len(take.labels)), columns),
        damaged_markers=markers[middle],
        cleaned_markers=result.take.markers[middle],
        captured_markers=sound.take.markers[middle],
        markers_only_joints=markers_only[row],
        cleaned_joints=cleaned[row],
        true_joints=true[row],
        markers_only_mm=markers_only_mm,
        cleaned_mm=cleaned_mm,
    )


def solve_markers_only(
    result: CleaningResult, subject: Subject, motion: Motion, frames: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N J 3"]:
    """Return the joint positions in metres from the damaged markers of each frame only, started at the mean pose."""
    take, skeleton = result.input_take, subject.skeleton
    columns = np.array([take.bare_labels.index(label) if label in take.bare_labels else -1 for label in subject.labels])
    measured = np.ascontiguousarray(take.select(columns, take.visible).markers[frames])
    weight = ~np.isnan(measured[..., 0]) / HAND_MARKER_SD_M**2
    points = PointTerm(subject.joints, subject.marker_offsets, np.nan_to_num(measured), weight)
    start = np.tile(load_mean_pose_prior("mean-pose", skeleton).mean_rotations, (len(frames), 1, 1, 1))
    start[:, 0] = motion.local_rotations[frames, 0]
    tree = kinematics.build_kinematic_tree(skeleton)
    solution = solve_without_prior(tree, points, motion.root_position[frames], start)
    return place_solved_poses(skeleton, solution).joint_positions

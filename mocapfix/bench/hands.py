"""MNN-IK's application to optical capture (5.1), on real takes: a hand left with one marker, and hands that cross amid noise.

A sound capture is damaged for a while and cleaned, the person's calibration being known from the sound one; what comes out is
held against that, cleaned too. Beside it stands what numerical inverse kinematics makes of the damaged markers alone.
"""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mocapfix import pipeline, write
from mocapfix.bench.compared_priors import place_solved_poses, solve_without_prior
from mocapfix.errors import TakeError
from mocapfix.kernels.terms import PointTerm
from mocapfix.motion import Motion
from mocapfix.pose_prior import mean_pose
from mocapfix.read import capture
from mocapfix.result import CleaningResult
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

DAMAGE_DURATION_S = 2.0  # that the damage lasts
HAND_NOISE_SD_M = 0.03  # metres per axis, anew in every frame
HAND_MARKER_SD_M = 0.01  # metres: how sure a marker is said to be, where there is nothing else to believe


class HandDamage(NamedTuple):
    """What is done to a sound take around one frame."""

    labels: tuple[str, ...]
    joints: tuple[str, ...]  # by which the harm is measured
    find_frame: Callable[[Take], int]
    damage_markers: Callable[[np.ndarray], np.ndarray]  # to the markers (T, K, 3)


class HandComparison(NamedTuple):
    """The middle of the damage: joints (J, 3) and markers (M, 3) in metres, NaN where there are none."""

    skeleton: Skeleton
    measured_joints: list[int]  # joints
    is_damaged: np.ndarray  # (M,) bool
    damaged_markers: np.ndarray  # markers: damaged,
    cleaned_markers: np.ndarray  # mended,
    captured_markers: np.ndarray  # and as they were captured
    markers_only_joints: np.ndarray  # joints: from this frame's damaged markers and nothing else,
    cleaned_joints: np.ndarray  # from the cleaned take,
    true_joints: np.ndarray  # and from the sound one, cleaned
    markers_only_mm: float  # mean error of the measured joints over all frames of the damage
    cleaned_mm: float


def find_highest_hand_frame(take: Take) -> int:
    """-> the frame in which the right hand is highest."""
    return int(np.nanargmax(get_hand_marker(take, "RFIN")[:, 1]))


def find_nearest_hands_frame(take: Take) -> int:
    """-> the frame in which the hands are nearest to one another."""
    return int(np.nanargmin(np.linalg.norm(get_hand_marker(take, "LFIN") - get_hand_marker(take, "RFIN"), axis=1)))


def get_hand_marker(take: Take, label: str) -> np.ndarray:
    """-> (T, 3) metres, a marker. Raises TakeError where the take has none of that name, or never shows it."""
    marker = take.markers[:, find_marker_column(take, label)]
    if np.isnan(marker).any(axis=1).all():
        raise TakeError(f"{take.name}: never shows the marker {label}; give a take that does.")
    return marker


def find_marker_column(take: Take, label: str) -> int:
    """-> which of a take's markers goes by a label. Raises TakeError where none does."""
    if label not in take.bare_labels:
        raise TakeError(f"{take.name}: has no marker {label}; give a take in CMU's 41 markers.")
    return take.bare_labels.index(label)


def remove_samples(markers: np.ndarray) -> np.ndarray:
    return np.full_like(markers, np.nan)


def add_noise(markers: np.ndarray) -> np.ndarray:
    return markers + np.random.default_rng(0).normal(0, HAND_NOISE_SD_M, markers.shape)


RIGHT_HAND_JOINTS = ("RightForeArm", "RightHand", "RightFingerBase")
LEFT_HAND_JOINTS = ("LeftForeArm", "LeftHand", "LeftFingerBase")
ONE_MARKER_DAMAGE = HandDamage(("RFRM", "RWRA", "RWRB"), RIGHT_HAND_JOINTS, find_highest_hand_frame, remove_samples)  # RFIN stays
CROSSED_HANDS_DAMAGE = HandDamage(
    tuple(side + of for side in "LR" for of in ("FRM", "WRA", "WRB", "FIN")),
    LEFT_HAND_JOINTS + RIGHT_HAND_JOINTS,
    find_nearest_hands_frame,
    add_noise,
)


def compare_hands(path: Path, damage: HandDamage) -> HandComparison:
    """-> what comes of a capture that is damaged.

    Raises ReadError where the file cannot be read, TakeError where it lacks the markers or no body could be solved.
    """
    take, sound = capture.read_take(path), pipeline.clean(path)
    middle, half = damage.find_frame(take), round(DAMAGE_DURATION_S / 2 * take.rate)
    columns = [find_marker_column(take, label) for label in damage.labels]
    during, markers = slice(max(middle - half, 0), middle + half), take.markers.copy()
    markers[during, columns] = damage.damage_markers(markers[during, columns])
    with TemporaryDirectory() as folder:
        spoiled = Path(folder) / path.name
        write.patch_c3d(spoiled, take, take.replace_markers(markers))
        mended = pipeline.clean(spoiled, subject=sound.subject)
    subject, motion, cleaned, true = mended.subject, mended.motion, mended.joint_position_world, sound.joint_position_world
    if subject is None or motion is None or cleaned is None or true is None:
        raise TakeError(f"{take.name}: no body could be solved; give a take in CMU's 41 markers.")
    frames = np.arange(len(markers))[during]
    ways = (solve_markers_only(mended, subject, motion, frames), cleaned[during], true[during])
    joints, at = [subject.skeleton.find_joint(name) for name in damage.joints], int(np.flatnonzero(frames == middle)[0])
    errors = [1e3 * float(np.linalg.norm(way - ways[-1], axis=2)[:, joints].mean()) for way in ways[:2]]
    hurt = np.isin(np.arange(len(take.labels)), columns)
    shown = (markers[middle], mended.take.markers[middle], sound.take.markers[middle])
    return HandComparison(subject.skeleton, joints, hurt, *shown, *(way[at] for way in ways), *errors)


def solve_markers_only(result: CleaningResult, subject: Subject, motion: Motion, frames: np.ndarray) -> np.ndarray:
    """-> (N, J, 3) metres: the joints as the damaged markers of each frame alone place them, from the mean pose."""
    take = result.input_take
    columns = np.array([take.bare_labels.index(label) if label in take.bare_labels else -1 for label in subject.labels])
    seen = np.ascontiguousarray(take.select(columns, take.visible).markers[frames])
    points = PointTerm(subject.joints, subject.marker_offsets, np.nan_to_num(seen), ~np.isnan(seen[..., 0]) / HAND_MARKER_SD_M**2)
    start = np.tile(mean_pose.load_mean_pose_prior("mean-pose", subject.skeleton).mean_rotations, (len(frames), 1, 1, 1))
    start[:, 0] = motion.local_rotations[frames, 0]
    return place_solved_poses(
        subject.skeleton,
        solve_without_prior(kinematics.build_kinematic_tree(subject.skeleton), points, motion.root_position[frames], start),
    ).joint_positions

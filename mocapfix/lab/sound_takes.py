"""Motion with known truth of people that no shipped model was trained on: takes without faults, and single poses.

Composed takes need no data. Performed takes are recordings of subjects that no model was trained on, at the rate of a capture
system. In both cases the body is drawn with asymmetric bones, sliding skin and camera noise. Faults can be injected into them.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from mocapfix.errors import ReadError, SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab.recordings import Recording, read_recordings, read_shard_recordings
from mocapfix.lab.training_poses import find_longest_jump_free_slice, find_weakly_observed_joints
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior
from mocapfix.solve.motion_solver import complete_motion, solve_changed_frames
from mocapfix.solve.pose_prior import remove_heading
from mocapfix.solve.pose_problem import build_motion_problem, change_all_frames
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.synthetic import SyntheticTake, compose_take, draw_subject, simulate_markers

SOUND_TAKE_RATE_HZ = 120.0
SOUND_TAKE_DURATION_S = 20.0  # of a longer recording the beginning is used
MIN_RECORDING_S = 8.0  # shorter recordings are not used


class PerformedMotion(NamedTuple):
    """A recording without jumps, as motion of the average body."""

    motion: Motion
    rate_hz: float
    name: str
    bones: Float[np.ndarray, "J 3"] | None = None  # metres: the offsets of the person's joints, where they are known


def iterate_sound_takes(motion_folder: Path | None, take_count: int) -> Iterator[tuple[str, SyntheticTake]]:
    """Yield the names of takes and the takes: `take_count` composed ones, or as many as the motion folder's recordings allow.

    Raises:
        SceneError: If `take_count` is less than one.
        ReadError: If the folder has no test.npz or its recordings are too short.
    """
    if take_count < 1:
        raise SceneError(f"The number of takes must be at least 1, not {take_count}.")
    if motion_folder is None:
        for seed in range(take_count):
            take = compose_take(seed, SOUND_TAKE_DURATION_S, SOUND_TAKE_RATE_HZ, asymmetric=True)
            yield f"seed {seed}", remove_damage(take)
        return
    performances = choose_performances(list(read_performed_motions(motion_folder / "test.npz")), take_count)
    if not performances:
        raise ReadError(f"{motion_folder / 'test.npz'}: holds no recording of {MIN_RECORDING_S:g} s or longer.")
    for number, performance in enumerate(performances):
        yield performance.name, perform_take(performance, np.random.default_rng(number))


def read_performed_motions(path: Path) -> Iterator[PerformedMotion]:
    """Yield the recordings of a shard without jumps, with root positions. Raises ReadError if the file is not a shard."""
    yield from map(cut_performance, read_shard_recordings(path))


def cut_performance(recording: Recording) -> PerformedMotion:
    """Return the longest part of a recording without jumps."""
    is_observed = ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    kept = find_longest_jump_free_slice(recording.rotations[:, is_observed], recording.rate_hz)
    motion = build_known_motion(recording.root_position[kept], recording.rotations[kept])
    return PerformedMotion(motion, recording.rate_hz, recording.name, recording.bones)


def remove_damage(truth: SyntheticTake) -> SyntheticTake:
    """Return the take without missing samples and spikes."""
    empty = np.zeros_like(truth.missing_mask)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=empty, spike_mask=empty)


def choose_performances(
    performances: list[PerformedMotion], take_count: int, shortest_s: float = MIN_RECORDING_S
) -> list[PerformedMotion]:
    """Return at most `take_count` recordings that are long enough: first the longest of every subject, then the second
    longest.
    """
    ranked: list[tuple[int, PerformedMotion]] = []
    for _, group in groupby(performances, lambda performance: performance.name.split("_")[0]):
        by_duration = sorted(group, key=lambda performance: -_compute_duration_s(performance))
        ranked += [(rank, each) for rank, each in enumerate(by_duration) if _compute_duration_s(each) >= shortest_s]
    return [performance for _, performance in sorted(ranked, key=lambda pair: pair[0])][:take_count]


def perform_take(performance: PerformedMotion, rng: np.random.Generator, *, has_own_bones: bool = False) -> SyntheticTake:
    """Return the recording as a take of a random subject with the same joint rotations; on other bones standing feet slide."""
    subject, motion = draw_subject(rng, asymmetric=True), resample_performance(performance)
    if has_own_bones and performance.bones is not None:
        subject = replace(subject, skeleton=replace(subject.skeleton, offsets=performance.bones))
    joint_positions, marker_positions = simulate_markers(rng, subject, motion, SOUND_TAKE_RATE_HZ)
    empty = np.zeros(marker_positions.shape[:2], bool)
    return SyntheticTake(
        motion,
        subject,
        joint_positions,
        marker_positions,
        damaged_positions=marker_positions,
        missing_mask=empty,
        spike_mask=empty,
        labels=subject.labels,
        rate=SOUND_TAKE_RATE_HZ,
    )


def resample_performance(performance: PerformedMotion) -> Motion:
    """Return the first SOUND_TAKE_DURATION_S of the motion at SOUND_TAKE_RATE_HZ, by smooth splines of rotations and
    positions.
    """
    frame_count = min(performance.motion.frame_count, round(SOUND_TAKE_DURATION_S * performance.rate_hz))
    old_times_s = np.arange(frame_count) / performance.rate_hz
    new_times_s = np.arange(round(old_times_s[-1] * SOUND_TAKE_RATE_HZ) + 1) / SOUND_TAKE_RATE_HZ
    rotations = performance.motion.local_rotations[:frame_count]
    resampled = [
        RotationSpline(old_times_s, Rotation.from_matrix(rotations[:, j]))(new_times_s).as_matrix()
        for j in range(rotations.shape[1])
    ]
    root_position = make_interp_spline(old_times_s, performance.motion.root_position[:frame_count])(new_times_s)
    return build_known_motion(root_position, np.ascontiguousarray(np.stack(resampled, 1)))


def _compute_duration_s(performance: PerformedMotion) -> float:
    return performance.motion.frame_count / performance.rate_hz


def find_informative_markers(subject: Subject) -> Bool[np.ndarray, "J K"]:
    """Return the markers on the segments on either side of each joint, or those on the nearest ancestor with markers."""
    parents = subject.skeleton.parents
    is_attached = subject.joints == np.arange(len(subject.skeleton.names))[:, None]
    is_informative = is_attached.copy()
    for j in range(1, len(parents)):
        ancestor = parents[j]
        is_informative[j] |= is_attached[ancestor]
        while not is_informative[j].any() and ancestor > 0:
            ancestor = parents[ancestor]
            is_informative[j] |= is_attached[ancestor]
    return is_informative


# `test_subjects` of all settings in priors/
UNSEEN_SUBJECTS = frozenset({"02", "05", "06", "16", "49", "85", "tilling-mmk", "basket-s010", "ys2010-boxer"})
HALF_TURN_STEPS = 32767  # integer that stands for half a turn in the shipped Euler angles


def load_unseen_poses() -> Float[np.ndarray, "N J 3 3"]:
    """Return the shipped poses, 1000 of them, as local rotations without heading."""
    with np.load(find_bench_file("unseen-poses.npz")) as file:
        angles = file["euler"] * (np.pi / HALF_TURN_STEPS)
    return Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape, 3)


def sample_subject_poses(
    motion_folder: Path, max_poses: int, subjects: frozenset[str] = UNSEEN_SUBJECTS
) -> Float[np.ndarray, "N J 3 3"]:
    """Return at most `max_poses` poses of some subjects, evenly spaced over their frames without jumps in a folder of motion.

    Raises:
        ReadError: If the folder holds no motion of these subjects.
    """
    is_observed = ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    parts = [
        each.rotations[find_longest_jump_free_slice(each.rotations[:, is_observed], each.rate_hz)]
        for each in read_recordings([motion_folder])
        if each.subject in subjects
    ]
    if not parts:
        raise ReadError(f"{motion_folder}: holds no motion of the test subjects {', '.join(sorted(UNSEEN_SUBJECTS))}.")
    poses = np.concatenate(parts)
    poses = poses[np.linspace(0, len(poses) - 1, min(max_poses, len(poses))).astype(int)]
    poses[:, 0] = remove_heading(poses[:, 0])
    return np.ascontiguousarray(poses)


def find_bench_file(name: str) -> Path:
    """Return the path of a file in scenes/bench. Raises SceneError in an installed package, which holds no such files."""
    folder = find_shipped_folder("scenes") / "bench"
    if not folder.is_dir():
        raise SceneError(f"{name}: the data of the benchmarks is not installed; run this in a checkout of the repository.")
    return folder / name


def build_known_motion(root_position: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T J 3 3"]) -> Motion:
    """Return known poses as a motion: positions in metres, local rotations, and standard deviations of zero."""
    zeros, joint_sd = np.zeros(len(root_position), int), np.zeros(rotations.shape[:2])
    root_position, rotations = np.ascontiguousarray(root_position), np.ascontiguousarray(rotations)
    return Motion(root_position, rotations, zeros, zeros, joint_sd[:, :0], joint_sd)


def solve_motion(
    take: Take,
    subject: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    limits: JointLimits,
    initial_motion: Motion,
    options: SolveOptions,
    *,
    conditioner: PriorConditioner | None = None,
) -> Motion:
    """Return the poses of all frames, with the standard deviations of every joint and of every marker as the body places it.

    Args:
        take: The markers in the subject's order, NaN if not visible or an outlier.
        prior: The mean pose of independent joints, which makes every frame determinate.
        initial_motion: The start of each frame's first solve.
        conditioner: A trained pose model; used only if a limb is occluded for so long that the take itself does not determine it.
    """
    problem = build_motion_problem(take, subject, body, prior, limits, options)
    start = replace(
        initial_motion, root_position=initial_motion.root_position.copy(), local_rotations=initial_motion.local_rotations.copy()
    )
    motion, evidence = solve_changed_frames(problem, start, change_all_frames(take.frame_count))
    return complete_motion(problem, motion, evidence, conditioner)[0]

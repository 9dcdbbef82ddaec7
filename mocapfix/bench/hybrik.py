"""The benchmark of HybrIK's closed form: the papers' tables on unseen subjects, its speed, and its use as a start of the
solver."""

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from mocapfix.bench.common_task import build_known_motion
from mocapfix.bench.given_joints import time_rounds
from mocapfix.bench.initialisation import measure_initialisation
from mocapfix.bench.joint_noise import NO_TWISTS, build_cmu41_subject, compute_noise_ratios, measure_joint_noise
from mocapfix.bench.twists import measure_twist_sources
from mocapfix.bench.unseen_poses import load_unseen_poses, sample_subject_poses
from mocapfix.initialise import initial_motion
from mocapfix.initialise.hybrik import HybrikVariant, solve_hybrik
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.parallel import count_cores
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_HYBRIK_POSES = 10_000  # of a motion folder
SPEED_FRAME_COUNT = 60_000  # frames of which the speed is measured
HYBRIK_SPEED_ROUNDS = 5  # the median counts
POSES_TAKE_RATE_HZ = 120.0  # of a take that consists of independent poses


def measure_hybrik(motion_folder: Path | None, capture_folder: Path | None, progress: ProgressCallback) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON.

    motion_folder   CMU motion whose test subjects give the poses and, in its test.npz, takes for the starts; None for the shipped
                    poses
    capture_folder  C3D files, also for the starts

    Raises ReadError if a folder does not hold the required files.
    """
    progress("reading")
    poses = sample_subject_poses(motion_folder, MAX_HYBRIK_POSES) if motion_folder else load_unseen_poses()
    subject = build_cmu41_subject()
    noise_results = measure_joint_noise(poses, progress)
    results: dict[str, Any] = {"poses": len(poses), "threads": count_cores()} | noise_results
    results["ratios"] = {key: compute_noise_ratios(noise_results[key]) for key in ("jitter_mm", "wrong_bones_mm")}
    results["twist"] = measure_twist_sources(poses, subject, progress)
    progress("frames per second")
    results |= measure_hybrik_speeds(poses, subject)
    results["starts"] = measure_initialisation(motion_folder=motion_folder, capture_folder=capture_folder, progress=progress)
    return results


def measure_hybrik_speeds(poses: Float[np.ndarray, "N J 3 3"], subject: Subject) -> dict[str, Any]:
    """Return the frames per second on all cores for repeated poses in memory.

    fps               variant X from joint positions, with regressed twists
    fps_by_way        the closed form of each variant only, with given twists
    from_markers_fps  variant X from markers, whose joint positions are estimated first
    """
    rotations = np.tile(poses, (-(-SPEED_FRAME_COUNT // len(poses)), 1, 1, 1))
    frame_count = len(rotations)
    motion = build_known_motion(np.zeros((frame_count, 3)), rotations)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    take, body = Take(markers, subject.labels, POSES_TAKE_RATE_HZ), load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)

    def measure_variant(variant: HybrikVariant) -> float:
        return compute_frames_per_second(frame_count, lambda: solve_hybrik(joints, subject, variant=variant, twists=NO_TWISTS))

    return {
        "fps": compute_frames_per_second(frame_count, lambda: solve_hybrik(joints, subject)),
        "fps_by_way": {variant: measure_variant(variant) for variant in get_args(HybrikVariant)},
        "from_markers_fps": compute_frames_per_second(
            frame_count, lambda: initial_motion.initialise_motion(take, subject, body, prior, method="hybrik-x")
        ),
    }


def compute_frames_per_second(frame_count: int, call: Callable[[], object]) -> float:
    """Return the frames per second by the median of several rounds."""
    return frame_count / median(time_rounds(call, HYBRIK_SPEED_ROUNDS))

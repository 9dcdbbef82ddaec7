"""What HybrIK's closed form is worth: the papers' tables on people whom no model has seen, its speed, and it as a start."""

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import get_args

import numpy as np

from mocapfix.bench import initialisation, joint_noise, twists, unseen_poses
from mocapfix.bench.given_joints import time_rounds
from mocapfix.bench.common_task import build_known_motion
from mocapfix.initialise import initial_motion
from mocapfix.initialise.hybrik import HybrikVariant
from mocapfix.initialise.initial_motion import solve_hybrik
from mocapfix.pose_prior import mean_pose
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.parallel import count_cores
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_HYBRIK_POSES = 10_000  # of a folder's, at most
SPEED_FRAME_COUNT = 60_000  # at a time, of which the speed is told
HYBRIK_SPEED_ROUNDS = 5
POSES_TAKE_RATE_HZ = 120.0  # Hz, of a take that is nothing but poses


def measure_hybrik(motion_folder: Path | None, capture_folder: Path | None, progress: ProgressCallback) -> dict:
    """-> every figure of the benchmark, ready for JSON.

    data      a folder of CMU motion whose `test` subjects are the poses and, in its test.npz, takes for the starts; None for the
              poses that ship
    captures  a folder of C3D files, for the starts, too

    Raises ReadError where a folder does not hold what it should.
    """
    progress("reading")
    poses = (
        unseen_poses.sample_subject_poses(motion_folder, MAX_HYBRIK_POSES) if motion_folder else unseen_poses.load_unseen_poses()
    )
    subject = joint_noise.build_cmu41_subject()
    shaken = joint_noise.measure_joint_noise(poses, progress)
    said = {"poses": len(poses), "threads": count_cores()} | shaken
    said["ratios"] = {key: joint_noise.compute_noise_ratios(shaken[key]) for key in ("jitter_mm", "wrong_bones_mm")}
    said["twist"] = twists.measure_twist_sources(poses, subject, progress)
    progress("frames a second")
    said |= measure_hybrik_speeds(poses, subject)
    said["starts"] = initialisation.measure_initialisation(
        motion_folder=motion_folder, capture_folder=capture_folder, progress=progress
    )
    return said


def measure_hybrik_speeds(poses: np.ndarray, subject: Subject) -> dict:
    """-> frames a second on all cores, of poses (N, J, 3, 3) over and over, from arrays in memory.

    fps               X from joint positions, its twists regressed
    fps_by_way        each way's closed form alone, its twists given
    from_markers_fps  X from markers: their joint positions, too
    """
    turned = np.tile(poses, (-(-SPEED_FRAME_COUNT // len(poses)), 1, 1, 1))
    joints, markers = kinematics.compute_joint_and_marker_positions(
        subject, build_known_motion(np.zeros((len(turned), 3)), turned)
    )
    worn, body = Take(markers, subject.labels, POSES_TAKE_RATE_HZ), load_cmu31_body()
    habits = mean_pose.load_mean_pose_prior("mean-pose", body.skeleton)
    return {
        "fps": compute_frames_per_second(len(turned), lambda: solve_hybrik(joints, subject)),
        "fps_by_way": {
            way: compute_frames_per_second(
                len(turned), lambda w=way: solve_hybrik(joints, subject, variant=w, twists=joint_noise.NO_TWISTS)
            )
            for way in get_args(HybrikVariant)
        },
        "from_markers_fps": compute_frames_per_second(
            len(turned), lambda: initial_motion.initialise_motion(worn, subject, body, habits, method="hybrik-x")
        ),
    }


def compute_frames_per_second(frame_count: int, call: Callable[[], object]) -> float:
    """-> frames a second, by the median over ROUNDS."""
    return frame_count / median(time_rounds(call, HYBRIK_SPEED_ROUNDS))

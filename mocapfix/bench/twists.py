"""Benchmark of bone twists: exact joints with twists from different sources (HybrIK, Table 1), and the twists of CMU's motion.

Joint positions do not determine the twist of a bone. Twists are drawn at random, set to zero, regressed from the joints, or
estimated from markers, exact or with noise. The body's markers show the error of the twists.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.bench.common_task import build_known_motion
from mocapfix.initialise.bones import find_separate_joints
from mocapfix.initialise.hybrik import solve_hybrik
from mocapfix.initialise.twist_regressor import compute_bone_vectors, compute_twists
from mocapfix.motion import Motion
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.train.recordings import read_recordings
from mocapfix.train.training_poses import find_longest_jump_free_slice

TWIST_MARKER_NOISE_SD_M = 0.01  # per axis
CERTAIN_TWIST_WEIGHT = 1e9  # 1/rad^2: outweighs all other information
TWIST_PERCENTILES = (1, 25, 50, 75, 99)


def measure_twist_sources(
    rotations: Float[np.ndarray, "N J 3 3"], subject: Subject, progress: ProgressCallback
) -> dict[str, dict[str, Any]]:
    """Return the errors of poses by source of the twists."""
    true, rng = build_known_motion(np.zeros((len(rotations), 3)), rotations), np.random.default_rng(0)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, true)
    angle = rng.uniform(-np.pi, np.pi, joints.shape[:2])
    random_twists = CERTAIN_TWIST_WEIGHT * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    zero_twists = CERTAIN_TWIST_WEIGHT * np.broadcast_to([1.0, 0.0], (1, joints.shape[1], 2))
    noisy_markers = markers + rng.normal(0, TWIST_MARKER_NOISE_SD_M, markers.shape)
    sources: dict[str, tuple[np.ndarray | None, np.ndarray | None]] = {  # twists and markers
        "random": (random_twists, None),
        "zero": (zero_twists, None),
        "regressed": (None, None),
        "noisy_markers": (None, noisy_markers),
        "markers": (None, markers),
    }
    results: dict[str, dict[str, Any]] = {}
    for name, (given_twists, given_markers) in sources.items():
        progress(f"twists: {name}")
        solution = solve_hybrik(joints, subject, twists=given_twists, markers=given_markers)
        results[name] = compute_twist_source_errors(subject, solution, true)
    return results


def compute_twist_source_errors(subject: Subject, solution: Motion, true: Motion) -> dict[str, Any]:
    """Return the mean errors of joints and markers in mm, and the rotation error of each bone in degrees.

    Both ends of a bone are given exactly, so its rotation error is the error of its twist.
    """
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, solution)
    true_joints, true_markers = kinematics.compute_joint_and_marker_positions(subject, true)
    rotation_error = compute_world_rotation_error(subject, solution, true)
    bones = np.unique(subject.skeleton.parents[find_separate_joints(subject.skeleton)])
    names = subject.skeleton.names
    return {
        "joints_mm": 1e3 * float(np.linalg.norm(joints - true_joints, axis=2).mean()),
        "markers_mm": 1e3 * float(np.linalg.norm(markers - true_markers, axis=2).mean()),
        "twist_deg": {names[j]: float(np.degrees(rotation_error[:, j].mean())) for j in bones if j > 0},
    }


def compute_world_rotation_error(subject: Subject, solution: Motion, true: Motion) -> Float[np.ndarray, "N J"]:
    """Return the angles in radians between the world rotations of joints and the true ones."""
    solved, expected = (kinematics.compute_world_poses(subject.skeleton, each)[1] for each in (solution, true))
    difference = np.swapaxes(expected, 2, 3) @ solved
    return Rotation.from_matrix(difference.reshape(-1, 3, 3)).magnitude().reshape(difference.shape[:2])


def compute_twist_distribution(motion_folder: Path) -> dict[str, tuple[float, ...]]:
    """Return percentiles in degrees of the twist of each bone over all motion in a folder (HybrIK, section 3.3, Fig. 5).

    Frames beyond a rotation jump are not used. Raises ReadError if the folder holds no motion.
    """
    skeleton = load_cmu31_skeleton()
    bone_vectors = compute_bone_vectors(skeleton)
    has_bone = ~np.isnan(bone_vectors[:, 0])
    parts: list[np.ndarray] = []
    for recording in read_recordings(motion_folder):
        kept = find_longest_jump_free_slice(recording.rotations[:, has_bone], recording.rate_hz)
        twists = compute_twists(recording.rotations[kept][:, has_bone], bone_vectors[has_bone])
        parts.append(np.degrees(np.arctan2(twists[..., 1], twists[..., 0])))
    percentiles = np.nanpercentile(np.concatenate(parts), TWIST_PERCENTILES, axis=0).T
    names = [name for name, each in zip(skeleton.names, has_bone, strict=True) if each]
    return {name: tuple(map(float, row)) for name, row in zip(names, percentiles, strict=True)}

"""What bones' twists are worth: joints are given exactly, and the body's markers show how its bones are turned (HybrIK, Table 1).

Joints lie on bones and say nothing of their twists. These are drawn at random, or left out, or what people do whose joints are
so, or what the markers themselves say, seen exactly or NOISE off.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench.common_task import build_known_motion
from mocapfix.initialise.bones import find_separate_joints
from mocapfix.initialise.initial_motion import solve_hybrik
from mocapfix.initialise.twist_regressor import compute_bone_vectors, compute_twists
from mocapfix.motion import Motion
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.train import recording_folders
from mocapfix.train.training_poses import find_longest_jump_free_slice

# MERGED: mocapfix.bench.off_bones
TWIST_MARKER_NOISE_SD_M = 0.01  # metres per axis
CERTAIN_TWIST_WEIGHT = 1e9  # 1/rad^2: as sure of a twist as nothing else is


def measure_twist_sources(rotations: np.ndarray, subject: Subject, progress: ProgressCallback) -> dict[str, dict]:
    """-> whence the twists are: of poses (N, J, 3, 3), what `errors` says."""
    true, rng = build_known_motion(np.zeros((len(rotations), 3)), rotations), np.random.default_rng(0)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, true)
    angle = rng.uniform(-np.pi, np.pi, joints.shape[:2])
    sources = {
        "random": {"twists": CERTAIN_TWIST_WEIGHT * np.stack([np.cos(angle), np.sin(angle)], axis=-1)},
        "zero": {"twists": CERTAIN_TWIST_WEIGHT * np.broadcast_to([1.0, 0.0], (1, joints.shape[1], 2))},
        "regressed": {},
        "noisy_markers": {"markers": markers + rng.normal(0, TWIST_MARKER_NOISE_SD_M, markers.shape)},
        "markers": {"markers": markers},
    }
    said = {}
    for name, source in sources.items():
        progress(f"twists: {name}")
        said[name] = compute_twist_source_errors(subject, solve_hybrik(joints, subject, **source), true)
    return said


def compute_twist_source_errors(subject: Subject, solution: Motion, true: Motion) -> dict:
    """-> mean distances of joints and markers from where the true motion carries them, mm; and of every bone's joint how far it
    is turned from the truth, degrees: since both its ends are right, that is the error of its twist.
    """
    (joints, markers), (there, worn) = (kinematics.compute_joint_and_marker_positions(subject, each) for each in (solution, true))
    turn = compute_world_rotation_error(subject, solution, true)
    bones = np.unique(subject.skeleton.parents[find_separate_joints(subject.skeleton)])
    return {
        "joints_mm": 1e3 * float(np.linalg.norm(joints - there, axis=2).mean()),
        "markers_mm": 1e3 * float(np.linalg.norm(markers - worn, axis=2).mean()),
        "twist_deg": {subject.skeleton.names[j]: float(np.degrees(turn[:, j].mean())) for j in bones if j > 0},
    }


def compute_world_rotation_error(subject: Subject, solution: Motion, true: Motion) -> np.ndarray:
    """-> (N, J) radians: how far joints are turned in the world from the truth."""
    one, other = (kinematics.compute_world_poses(subject.skeleton, each)[1] for each in (solution, true))
    turn = np.swapaxes(other, 2, 3) @ one
    return Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().reshape(turn.shape[:2])


# MERGED: mocapfix.bench.twists
# How far people's bones are twisted, joint by joint: the figure of HybrIK's section 3.3 (its Fig. 5), for CMU's motion.
TWIST_PERCENTILES = (1, 25, 50, 75, 99)


def compute_twist_distribution(motion_folder: Path) -> dict[str, tuple[float, ...]]:
    """-> degrees: PERCENTILES of the twist of each joint that has a bone, over all motion in a folder; flips are left out.

    Raises ReadError where there is none.
    """
    body = load_cmu31_skeleton()
    along, found = compute_bone_vectors(body), []
    has = ~np.isnan(along[:, 0])
    for recording in recording_folders.read_recordings(motion_folder):
        kept = find_longest_jump_free_slice(recording.rotations[:, has], recording.rate_hz)
        told = compute_twists(recording.rotations[kept][:, has], along[has])
        found.append(np.degrees(np.arctan2(told[..., 1], told[..., 0])))
    spread = np.nanpercentile(np.concatenate(found), TWIST_PERCENTILES, axis=0).T
    names = [name for name, it in zip(body.names, has, strict=True) if it]
    return {name: tuple(map(float, row)) for name, row in zip(names, spread, strict=True)}

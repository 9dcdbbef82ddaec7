"""Benchmark of HybrIK from known joints: bone twists from different sources (HybrIK, Table 1), and noisy joint positions.

Joint positions do not determine the twist of a bone. Twists are drawn at random, set to zero, regressed from the joints, or
estimated from markers, exact or with noise. The body's markers show the error of the twists.

HybrIK's variants are compared with noisy joint positions (HybrIK, Table 3; HybrIK-X, Table 7). The noise of a joint has a uniform
distribution along each axis. The result is compared with the true joints and, as in HybrIK's Eq. 14, with the given ones. Bones
are the true ones, or wrong: then the joints are those of composed people, whose joints are 8 mm off the average body's, as those
of CMU's subjects are, and the average body is solved.
"""

from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.hybrik import DEFAULT_JOINT_SD_M, HybrikVariant, find_separate_joints, solve_hybrik
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import draw_subject

JOINT_NOISE_MM = (0, 10, 20, 30)  # maximum along each axis
HAND_NAME_PARTS = ("Hand", "FingerBase", "Thumb")  # "Hand" includes HandIndex
COMPOSED_PEOPLE_COUNT = 20
NO_TWISTS = np.broadcast_to([1.0, 0.0], (1, len(load_cmu31_body().skeleton.names), 2))  # cosine and sine


class NoisyJoints(NamedTuple):
    """True and given joint positions (N, J, 3) in metres, and the standard deviation of the noise."""

    true_positions: np.ndarray
    given_positions: np.ndarray
    sd_m: float  # per axis


def measure_joint_noise(poses: Float[np.ndarray, "N J 3 3"], progress: ProgressCallback) -> dict[str, dict[str, Any]]:
    """Return the errors by quantity, by noise in mm, and by variant.

    - `jitter_mm`: distance from the true joints
    - `from_given_mm`: distance from the given joints
    - `given_mm`: distance of the given joints from the true ones
    - `wrong_bones_mm`: distance from the true joints, with wrong bones
    """
    subject = build_cmu41_subject()
    results: dict[str, dict[str, Any]] = {"jitter_mm": {}, "from_given_mm": {}, "given_mm": {}, "wrong_bones_mm": {}}
    motion = build_known_motion(np.zeros((len(poses), 3)), poses)
    average_joints, _ = kinematics.compute_world_poses(subject.skeleton, motion)
    composed_joints = compute_composed_joints(poses)
    for noise_mm in JOINT_NOISE_MM:
        progress(f"joint noise of {noise_mm} mm")
        right, wrong, key = add_joint_noise(average_joints, noise_mm), add_joint_noise(composed_joints, noise_mm), str(noise_mm)
        solved = {variant: solve_hybrik_joints(right, subject, variant) for variant in get_args(HybrikVariant)}
        results["jitter_mm"][key] = {
            variant: summarise_body_parts(joints, right.true_positions) for variant, joints in solved.items()
        }
        results["from_given_mm"][key] = {
            variant: summarise_body_parts(joints, right.given_positions) for variant, joints in solved.items()
        }
        results["given_mm"][key] = summarise_body_parts(right.given_positions, right.true_positions)
        results["wrong_bones_mm"][key] = {
            variant: summarise_body_parts(solve_hybrik_joints(wrong, subject, variant), wrong.true_positions)
            for variant in get_args(HybrikVariant)
        }
    return results


def build_cmu41_subject() -> Subject:
    """Return the average body with CMU's 41 markers."""
    skeleton, marker_set = load_cmu31_body().skeleton, load_marker_set("cmu41")
    joints, offsets = marker_set.joints, marker_set.marker_offsets
    return Subject(skeleton, marker_set.name, marker_set.labels, joints, offsets, marker_set.marker_spread)


def compute_composed_joints(rotations: Float[np.ndarray, "N J 3 3"]) -> Float[np.ndarray, "N J 3"]:
    """Return the joint positions in metres of composed people, who share the poses; the same people in every call."""
    seeds = range(COMPOSED_PEOPLE_COUNT)
    skeletons = [draw_subject(np.random.default_rng(seed), asymmetric=True).skeleton for seed in seeds]
    shares = np.array_split(rotations, COMPOSED_PEOPLE_COUNT)
    motions = [build_known_motion(np.zeros((len(share), 3)), share) for share in shares]
    people = zip(skeletons, motions, strict=True)
    return np.concatenate([kinematics.compute_world_poses(skeleton, motion)[0] for skeleton, motion in people])


def add_joint_noise(true_positions: Float[np.ndarray, "N J 3"], noise_mm: int) -> NoisyJoints:
    """Return joint positions with uniform noise along each axis; the same in every call."""
    limit_m = 1e-3 * noise_mm
    given = true_positions + np.random.default_rng(noise_mm).uniform(-limit_m, limit_m, true_positions.shape)
    return NoisyJoints(true_positions, given, limit_m / np.sqrt(3) or DEFAULT_JOINT_SD_M)


def solve_hybrik_joints(task: NoisyJoints, subject: Subject, variant: HybrikVariant) -> Float[np.ndarray, "N J 3"]:
    """Return the joint positions in metres that a variant of HybrIK finds."""
    motion = solve_hybrik(task.given_positions, subject, variant=variant, joint_sd=task.sd_m, twists=NO_TWISTS)
    return kinematics.compute_world_poses(subject.skeleton, motion)[0]


def summarise_body_parts(positions: Float[np.ndarray, "N J 3"], true_positions: Float[np.ndarray, "N J 3"]) -> dict[str, float]:
    """Return the mean distances in mm of all joints, of the hands and of the other joints."""
    distance_mm = 1e3 * np.linalg.norm(positions - true_positions, axis=2)
    is_hand = np.array([any(part in name for part in HAND_NAME_PARTS) for name in load_cmu31_body().skeleton.names])
    body_mm, hands_mm = distance_mm[:, ~is_hand].mean(), distance_mm[:, is_hand].mean()
    return {"all_mm": float(distance_mm.mean()), "body_mm": float(body_mm), "hands_mm": float(hands_mm)}


def compute_noise_ratios(errors: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return by noise the ratio of the errors of "adaptive" and "naive", and of "x" and "adaptive" for the hands."""
    return {
        noise: {
            "adaptive_over_naive_all": variants["adaptive"]["all_mm"] / variants["naive"]["all_mm"],
            "adaptive_over_naive_body": variants["adaptive"]["body_mm"] / variants["naive"]["body_mm"],
            "x_over_adaptive_hands": variants["x"]["hands_mm"] / variants["adaptive"]["hands_mm"],
        }
        for noise, variants in errors.items()
        if noise != "0"  # the errors are zero
    }


TWIST_MARKER_NOISE_SD_M = 0.01  # per axis
CERTAIN_TWIST_WEIGHT = 1e9  # 1/rad^2: outweighs all other information


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

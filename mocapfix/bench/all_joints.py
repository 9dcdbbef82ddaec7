"""Benchmark of pose priors when all joint positions are given, so that a prior is not needed.

A prior should not move joints that are given exactly, should not increase the error of noisy joints, and should give each bone a
natural twist, on which joint positions have no influence.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.bench.compared_priors import ComparedPriors, PlacedPoses, build_joint_task, place_known_poses, solve_joint_task
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import Skeleton

ALL_JOINTS_SD_M = 0.003  # per axis: standard deviation of the noise, also assumed by the solver
MIN_TWIST_BONE_LENGTH_M = 0.01  # two joints that are closer together have no bone between them


def measure_all_joints(
    rotations: Float[np.ndarray, "N J 3 3"],
    priors: ComparedPriors,
    reference_rotations: Float[np.ndarray, "J 3 3"],
    progress: ProgressCallback,
) -> dict[str, dict[str, float]]:
    """Return the effect of each prior on poses whose joint positions are all given.

    bias_mm    mean distance of exactly given joints from where they are without a prior
    noisy_mm   mean distance of joints from the truth if the given positions have noise of ALL_JOINTS_SD_M
    twist_deg  mean error of the bones' twist if the positions are given exactly
    """
    shape = rotations.shape[:2]
    noise = np.random.default_rng(0).normal(0, ALL_JOINTS_SD_M, (*shape, 3))
    exact_task = build_joint_task(rotations, np.ones(shape, bool), ALL_JOINTS_SD_M)
    noisy_task = build_joint_task(rotations, np.ones(shape, bool), ALL_JOINTS_SD_M, noise)
    truth = place_known_poses(exact_task.skeleton, np.zeros((len(rotations), 3)), rotations)
    results: dict[str, dict[str, float]] = {}
    without_prior = None
    for name, model in priors.items():
        progress(f"all joints given, {name}")
        exact, noisy = (solve_joint_task(task, model, task.build_start(reference_rotations)) for task in (exact_task, noisy_task))
        without_prior = without_prior or exact  # the first of the compared priors is no prior
        results[name] = {
            "bias_mm": compute_joint_distance_mm(exact, without_prior),
            "noisy_mm": compute_joint_distance_mm(noisy, truth),
            "twist_deg": float(np.degrees(compute_bone_twist_errors(exact_task.skeleton, exact, truth).mean())),
        }
    return results


def compute_joint_distance_mm(first: PlacedPoses, second: PlacedPoses) -> float:
    """Return the mean distance of the joints in mm."""
    return 1e3 * float(np.linalg.norm(first.joint_positions - second.joint_positions, axis=2).mean())


def compute_bone_twist_errors(skeleton: Skeleton, solution: PlacedPoses, truth: PlacedPoses) -> Float[np.ndarray, "N B"]:
    """Return the error of each bone's rotation about itself in radians.

    A bone is a joint with one child: two children determine its rotation, and a joint without children has no direction.
    """
    bones, children = find_twist_bones(skeleton)
    direction = truth.joint_positions[:, children] - truth.joint_positions[:, bones]
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    difference = solution.world_rotations[:, bones] @ np.swapaxes(truth.world_rotations[:, bones], 2, 3)
    quaternions = Rotation.from_matrix(difference.reshape(-1, 3, 3)).as_quat().reshape(*direction.shape[:2], 4)
    angle = 2 * np.arctan2((quaternions[..., :3] * direction).sum(axis=2), quaternions[..., 3])
    return np.abs((angle + np.pi) % (2 * np.pi) - np.pi)


def find_twist_bones(skeleton: Skeleton) -> tuple[Int[np.ndarray, " B"], Int[np.ndarray, " B"]]:
    """Return the joints that have exactly one child at some distance, and these children."""
    pairs: list[tuple[int, int]] = []
    for joint in range(len(skeleton.names)):
        children = np.flatnonzero(skeleton.parents == joint)
        if len(children) == 1 and np.linalg.norm(skeleton.offsets[children[0]]) > MIN_TWIST_BONE_LENGTH_M:
            pairs.append((joint, int(children[0])))
    bones, children = np.array(pairs).T
    return bones, children

"""The benchmark of pose priors when a few random joints are given (MNN-IK, 4.2), or all of them.

With a few joints, accuracy and speed are measured. As in the paper, poses are at the origin without heading, and every solve
starts at the mean pose. The error of a pose is the mean over its 31 joints; standard deviations are those of the errors of poses.
With all joints a prior is not needed; then its side effects are measured.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.lab.compared_priors import (
    ComparedPrior,
    ComparedPriors,
    JointTask,
    PlacedPoses,
    build_joint_task,
    load_compared_priors,
    place_with_joints,
    solve_joint_task,
)
from mocapfix.lab.lost_limbs import measure_lost_limbs
from mocapfix.lab.sound_takes import load_unseen_poses, sample_subject_poses
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.solve.pose_prior import PoseModel

ALL_JOINTS_SD_M = 0.003  # per axis: standard deviation of the noise, also assumed by the solver
MIN_TWIST_BONE_LENGTH_M = 0.01  # two joints that are closer together have no bone between them


def measure_all_joints(
    rotations: Float[np.ndarray, "N J 3 3"],
    priors: ComparedPriors,
    reference_rotations: Float[np.ndarray, "J 3 3"],
    progress: ProgressCallback,
) -> dict[str, dict[str, float]]:
    """Return the effect of each prior on poses whose joint positions are all given.

    - `bias_mm`: mean distance of exactly given joints from where they are without a prior
    - `noisy_mm`: mean distance of joints from the truth if the given positions have noise of ALL_JOINTS_SD_M
    - `twist_deg`: mean error of the bones' twist if the positions are given exactly
    """
    shape = rotations.shape[:2]
    noise = np.random.default_rng(0).normal(0, ALL_JOINTS_SD_M, (*shape, 3))
    exact_task = build_joint_task(rotations, np.ones(shape, bool), ALL_JOINTS_SD_M)
    noisy_task = build_joint_task(rotations, np.ones(shape, bool), ALL_JOINTS_SD_M, noise)
    truth = place_with_joints(exact_task.skeleton, np.zeros((len(rotations), 3)), rotations)
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


GIVEN_JOINT_COUNTS = (6, 8, 10, 15)
GIVEN_JOINT_SD_M = 0.005  # standard deviation of a given position that the solver assumes
SPEED_JOINT_COUNT = 10  # given joints of the poses that are timed
SPEED_ROUNDS = 3  # the fastest round counts, because other programs slow down some rounds
START_ROTATION_SD_RAD = 0.15  # per axis: difference between a pose and its start, as a smooth motion would give it
START_POSITION_SD_M = 0.03  # per axis: difference of the root position

PoseErrorRow = dict[str, float]
GivenJointResults = dict[str, dict[str, PoseErrorRow]]  # by number of given joints and by prior


def measure_given_joints(
    rotations: Float[np.ndarray, "N J 3 3"],
    priors: ComparedPriors,
    reference_rotations: Float[np.ndarray, "J 3 3"],
    sets_per_pose: int,
    progress: ProgressCallback,
) -> GivenJointResults:
    """Return the errors of poses by number of given joints and prior; each pose is solved `sets_per_pose` times with other
    joints.
    """
    results: GivenJointResults = {}
    for count in GIVEN_JOINT_COUNTS:
        is_given = draw_given_joints(sets_per_pose * len(rotations), rotations.shape[1], count)
        task = build_joint_task(np.concatenate([rotations] * sets_per_pose), is_given, GIVEN_JOINT_SD_M)
        results[str(count)] = {}
        for name, model in priors.items():
            progress(f"{count} joints given, {name}")
            solution = solve_joint_task(task, model, task.build_start(reference_rotations))
            results[str(count)][name] = summarise_pose_errors(*compute_pose_errors(task, solution))
    return results


def draw_given_joints(pose_count: int, joint_count: int, given_count: int) -> Bool[np.ndarray, "N J"]:
    """Return `given_count` random joints of each pose; the same ones in every call."""
    order = np.random.default_rng(given_count).random((pose_count, joint_count)).argsort(axis=1)
    return order < given_count


def compute_pose_errors(task: JointTask, solution: PlacedPoses) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return the position error in metres and the rotation error in radians of each pose, as means over its joints."""
    true = place_with_joints(task.skeleton, np.zeros((len(task.true_rotations), 3)), task.true_rotations)
    position_error_m = np.linalg.norm(solution.joint_positions - true.joint_positions, axis=2).mean(axis=1)
    difference = np.swapaxes(task.true_rotations, 2, 3) @ solution.rotations
    angles = Rotation.from_matrix(difference.reshape(-1, 3, 3)).magnitude().reshape(difference.shape[:2])
    return position_error_m, angles.mean(axis=1)


def summarise_pose_errors(position_error_m: Float[np.ndarray, " N"], rotation_error_rad: Float[np.ndarray, " N"]) -> PoseErrorRow:
    """Return means and standard deviations over poses, in mm and degrees."""
    position_mm, rotation_deg = 1e3 * position_error_m, np.degrees(rotation_error_rad)
    return {
        "position_mm": float(position_mm.mean()),
        "rotation_deg": float(rotation_deg.mean()),
        "position_sd": float(position_mm.std()),
        "rotation_sd": float(rotation_deg.std()),
    }


def compute_improvements(results: GivenJointResults, name: str) -> dict[str, dict[str, float]]:
    """Return by how many percent the errors of a prior are smaller than those of each other prior."""
    others = [other for other in next(iter(results.values())) if other != name]
    keys = {"position_percent": "position_mm", "rotation_percent": "rotation_deg"}
    return {
        other: {percent: compute_improvement_percent(results, name, other, key) for percent, key in keys.items()}
        for other in others
    }


def compute_improvement_percent(results: GivenJointResults, name: str, other: str, key: str) -> float:
    """Return the mean over the numbers of given joints, as MNN-IK averages its 25 and 39 % (4.2)."""
    return 100 * float(np.mean([1 - rows[name][key] / rows[other][key] for rows in results.values()]))


def measure_prior_speed(
    rotations: Float[np.ndarray, "N J 3 3"],
    model: ComparedPrior,
    reference_rotations: Float[np.ndarray, "J 3 3"],
    progress: ProgressCallback,
) -> dict[str, float]:
    """Return the frames per second on all cores, each frame solved independently.

    - `fps`: from a start close to the pose, as a smooth motion gives it
    - `fps_from_mean_pose`: from the mean pose
    """
    progress("frames per second")
    is_given = draw_given_joints(len(rotations), rotations.shape[1], SPEED_JOINT_COUNT)
    task, rng = build_joint_task(rotations, is_given, GIVEN_JOINT_SD_M), np.random.default_rng(0)
    vectors = rng.normal(0, START_ROTATION_SD_RAD, (rotations[..., 0, 0].size, 3))
    start_offsets = Rotation.from_rotvec(vectors).as_matrix().reshape(rotations.shape)
    starts = {
        "fps": (rng.normal(0, START_POSITION_SD_M, (len(rotations), 3)), start_offsets @ rotations),
        "fps_from_mean_pose": task.build_start(reference_rotations),
    }

    def time_start(start: tuple[np.ndarray, np.ndarray]) -> float:
        return min(time_rounds(lambda: solve_joint_task(task, model, start), SPEED_ROUNDS))

    return {name: len(rotations) / time_start(start) for name, start in starts.items()}


def time_rounds(call: Callable[[], object], rounds: int) -> list[float]:
    """Return the seconds of each round, after one call that is not timed and may compile."""
    call()
    durations_s: list[float] = []
    for _ in range(rounds):
        started = time.perf_counter()
        call()
        durations_s.append(time.perf_counter() - started)
    return durations_s


JOINT_SETS_PER_POSE = 3  # different sets of given joints for each pose


def measure_pose_priors(motion_folder: Path | None, max_poses: int, progress: ProgressCallback) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON.

    Args:
        motion_folder: Motion whose test subjects give the poses; None for the shipped poses. Lost limbs need the motion in its
            test.npz.
        max_poses: Maximum number of poses.

    Raises:
        SceneError, ReadError: If motion or weights are missing or invalid.
    """
    if max_poses < 1:
        raise SceneError(f"The number of poses must be at least 1, not {max_poses}.")
    priors = load_compared_priors()
    reference_rotations = load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
    progress("reading")
    poses = sample_subject_poses(motion_folder, max_poses) if motion_folder else load_unseen_poses()
    poses = poses[np.linspace(0, len(poses) - 1, min(max_poses, len(poses))).astype(int)]
    results: dict[str, Any] = {"poses": len(poses), "sets": JOINT_SETS_PER_POSE, "default": DEFAULT_PRIOR_NAME}
    results |= compare_priors(poses, priors, reference_rotations, progress)
    results["all_joints"] = measure_all_joints(poses, priors, reference_rotations, progress)
    results["bias_mm"] = results["all_joints"][DEFAULT_PRIOR_NAME]["bias_mm"]
    results |= measure_prior_speed(poses, priors[DEFAULT_PRIOR_NAME], reference_rotations, progress)
    results["limb"] = measure_limbs_if_possible(motion_folder, priors[DEFAULT_PRIOR_NAME], progress)
    return results


def compare_priors(
    poses: Float[np.ndarray, "N J 3 3"],
    priors: ComparedPriors,
    reference_rotations: Float[np.ndarray, "J 3 3"],
    progress: ProgressCallback,
) -> dict[str, Any]:
    """Return the errors with a few given joints, and by how much the default prior is better than the others."""
    results = measure_given_joints(poses, priors, reference_rotations, JOINT_SETS_PER_POSE, progress)
    return {"given_joints": results, "better": compute_improvements(results, DEFAULT_PRIOR_NAME)}


def measure_limbs_if_possible(
    motion_folder: Path | None, model: ComparedPrior, progress: ProgressCallback
) -> dict[str, Any] | None:
    """Return the errors of lost limbs, or None without a folder that holds motion of test subjects."""
    if motion_folder is None or not (motion_folder / "test.npz").is_file() or not isinstance(model, PoseModel):
        return None
    return measure_lost_limbs(motion_folder, model, progress=progress)

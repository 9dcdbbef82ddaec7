"""The benchmark of pose priors: MNN-IK's tests, and the side effects of a prior where it is not needed."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mocapfix.bench.compared_priors import ComparedPrior, ComparedPriors, load_compared_priors
from mocapfix.bench.given_joints import (
    compute_improvements,
    measure_all_joints,
    measure_given_joints,
    measure_iterations,
    measure_prior_speed,
)
from mocapfix.bench.lost_limbs import measure_lost_limbs
from mocapfix.bench.sound_takes import load_unseen_poses, sample_interleaved_poses, sample_subject_poses
from mocapfix.errors import SceneError
from mocapfix.files.option_choices import DEFAULT_PRIOR_NAME
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.pose_prior.model import PoseModel
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body

JOINT_SETS_PER_POSE = 3  # different sets of given joints for each pose
MAX_CURVE_POSES = 200  # enough for the curves over iterations


def measure_pose_priors(
    motion_folder: Path | None, max_poses: int, paper_split_folder: Path | None, with_iterations: bool, progress: ProgressCallback
) -> dict[str, Any]:
    """Return all results of the benchmark, ready for JSON.

    motion_folder       motion whose test subjects give the poses; None for the shipped poses. Lost limbs need the motion in its
                        test.npz
    max_poses           maximum number of poses
    paper_split_folder  weights that were trained on MNN-IK's own split, whose test is then done as well; needs `motion_folder`
    with_iterations     whether to measure the errors over the iterations

    Raises SceneError or ReadError if motion or weights are missing or invalid.
    """
    if max_poses < 1:
        raise SceneError(f"The number of poses must be at least 1, not {max_poses}.")
    if paper_split_folder and not motion_folder:
        raise SceneError("The test on the paper's split needs the motion that was trained on; give its folder with --data.")
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
    if paper_split_folder and motion_folder:
        interleaved = sample_interleaved_poses(motion_folder, max_poses)
        split_priors = load_compared_priors(paper_split_folder)
        results["paper_split"] = compare_priors(interleaved, split_priors, reference_rotations, progress)
    if with_iterations:
        curve_poses = poses[:: -(-len(poses) // MAX_CURVE_POSES)]
        curves = measure_iterations(curve_poses, priors, reference_rotations, DEFAULT_PRIOR_NAME, progress)
        results["iterations"] = curves
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

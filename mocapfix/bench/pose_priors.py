"""What the priors are worth: the benchmark of MNN-IK, and of what a prior must not do."""

from pathlib import Path

import numpy as np

from mocapfix.bench import all_joints, compared_priors, given_joints, lost_limbs, unseen_poses
from mocapfix.bench import given_joints as iterations
from mocapfix.bench import given_joints as speed
from mocapfix.bench.compared_priors import ComparedPrior, ComparedPriors
from mocapfix.errors import SceneError
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.model import PoseModel
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.skeleton import load_cmu31_body

JOINT_SETS_PER_POSE = 3  # of joints for each pose
MAX_CURVE_POSES = 200  # poses are enough for curves


def measure_pose_priors(
    motion_folder: Path | None, max_poses: int, paper_split_folder: Path | None, with_iterations: bool, progress: ProgressCallback
) -> dict:
    """-> every figure of the benchmark, ready for JSON.

    data         a folder of motion whose `test` subjects are the poses; None for the poses that ship. Limbs are lost in motion
                 alone, in that of its test.npz
    frames       how many poses, at most
    paper_split  a folder of weights trained on MNN-IK's own split, whose test is then done, too; needs `data`
    curves       whether to follow the errors over the iterations

    Raises SceneError or ReadError where data or weights are not what they must be.
    """
    if max_poses < 1:
        raise SceneError(f"Of {max_poses} poses nothing can be measured; ask for one at least.")
    if paper_split_folder and not motion_folder:
        raise SceneError("The paper's split is of the motion that was learned from; say with --data where it is.")
    shelf, middle = (
        compared_priors.load_compared_priors(),
        mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations,
    )
    progress("reading")
    poses = unseen_poses.sample_subject_poses(motion_folder, max_poses) if motion_folder else unseen_poses.load_unseen_poses()
    poses = poses[np.linspace(0, len(poses) - 1, min(max_poses, len(poses))).astype(int)]
    said = {"poses": len(poses), "sets": JOINT_SETS_PER_POSE, "default": DEFAULT_PRIOR_NAME} | compare_priors(
        poses, shelf, middle, progress
    )
    said["all_joints"] = all_joints.measure_all_joints(poses, shelf, middle, progress)
    said["bias_mm"] = said["all_joints"][DEFAULT_PRIOR_NAME]["bias_mm"]
    said |= speed.measure_prior_speed(poses, shelf[DEFAULT_PRIOR_NAME], middle, progress)
    said["limb"] = measure_limbs_if_possible(motion_folder, shelf[DEFAULT_PRIOR_NAME], progress)
    if paper_split_folder and motion_folder:
        said["paper_split"] = compare_priors(
            unseen_poses.sample_interleaved_poses(motion_folder, max_poses),
            compared_priors.load_compared_priors(paper_split_folder),
            middle,
            progress,
        )
    if with_iterations:
        said["iterations"] = iterations.measure_iterations(
            poses[:: -(-len(poses) // MAX_CURVE_POSES)], shelf, middle, DEFAULT_PRIOR_NAME, progress
        )
    return said


def compare_priors(
    poses: np.ndarray, priors: ComparedPriors, reference_rotations: np.ndarray, progress: ProgressCallback
) -> dict:
    """-> `given_joints`, and by how much the default is `better` than the others."""
    said = given_joints.measure_given_joints(poses, priors, reference_rotations, JOINT_SETS_PER_POSE, progress)
    return {"given_joints": said, "better": given_joints.compute_improvements(said, DEFAULT_PRIOR_NAME)}


def measure_limbs_if_possible(motion_folder: Path | None, model: ComparedPrior, progress: ProgressCallback) -> dict | None:
    """-> how far lost limbs are off, see `limb.run`; None where there is no motion to lose them in."""
    if motion_folder is None or not (motion_folder / "test.npz").is_file() or not isinstance(model, PoseModel):
        return None
    return lost_limbs.measure_lost_limbs(motion_folder, model, progress=progress)

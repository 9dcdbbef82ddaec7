"""The trained prior in every frame: joints that markers determine keep their poses, the others follow the rest of the body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, mean_pose, motion_solver, pose_problem, window_solver
from mocapfix.solve.pose_prior import GaussianModel
from mocapfix.solve.pose_problem import change_all_frames
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.solve.trained_priors import load_pose_model
from mocapfix.solve.window_solver import set_frame_prior
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
NAMES, JOINTS = BODY.skeleton.names, len(BODY.skeleton.names)
LEFT, RIGHT = NAMES.index("LeftForeArm"), NAMES.index("RightForeArm")
PRIOR, LIMITS = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), mean_pose.load_joint_limits(BODY.skeleton)


@pytest.fixture(scope="module")
def scene():
    """Return a composed take, and the problem of its true poses."""
    truth = compose_take(seed=4, seconds=2.0, rate=60.0)
    take = Take(truth.marker_positions, truth.labels, 60.0)
    return truth, pose_problem.build_motion_problem(take, truth.subject, BODY, PRIOR, LIMITS, SolveOptions())


def copy_right_forearm():
    """Return a model in which the left forearm turns about all axes as the right one does."""
    components = np.zeros((3, JOINTS, 3))
    for axis in range(3):
        components[axis, [LEFT, RIGHT], axis] = 1.0
    return GaussianModel(
        NAMES, np.tile(np.eye(3), (JOINTS, 1, 1)), np.full(JOINTS, 0.02), np.zeros((JOINTS, 3)), components, 0.02
    )


def get_poses(truth):
    return truth.motion.root_position.copy(), truth.motion.local_rotations.copy()


def build_term(model, problem, pose, weight=1e-3, frames=None):
    frame_count = len(pose[0])
    rows = np.arange(0, frame_count) if frames is None else frames
    nothing = np.zeros((frame_count, JOINTS), bool)
    return window_solver.build_frame_prior_term(
        model, weight, problem.pose_problem, PRIOR, pose, nothing, frames=rows, robust_scale_m=0.05
    )


def test_undetermined_joint_follows_the_rest_of_the_body(scene):
    truth, problem = scene
    pose = get_poses(truth)
    below = window_solver.find_moved_joints(BODY.skeleton.parents)[LEFT, truth.subject.joints]
    part = problem.pose_problem
    free_axes = replace(PRIOR, locked_information=np.zeros_like(PRIOR.locked_information))
    hidden = replace(part, solver_mask=part.solver_mask & ~below)
    nothing, frames = np.zeros((len(pose[0]), JOINTS), bool), np.arange(0, len(pose[0]))
    term = window_solver.build_frame_prior_term(
        copy_right_forearm(), 1e-3, hidden, free_axes, pose, nothing, frames=frames, robust_scale_m=0.05
    )
    difference = Rotation.from_matrix(term.rotations[:, LEFT] @ np.swapaxes(pose[1][:, RIGHT], 1, 2)).magnitude()
    assert np.median(difference) < 0.1


def test_well_seen_frames_are_not_biased(scene):
    truth, problem = scene
    conditioner = PriorConditioner(lambda: load_pose_model("autoencoder", BODY.skeleton), 1.0)
    error_m: list[float] = []
    for each in (problem, replace(problem, conditioner=conditioner)):
        root_position, local_rotations = get_poses(truth)
        start = replace(truth.motion, root_position=root_position, local_rotations=local_rotations)
        motion, _ = motion_solver.solve_changed_frames(each, start, change_all_frames(len(root_position)))
        joints = [kinematics.compute_joint_and_marker_positions(truth.subject, m)[0] for m in (motion, truth.motion)]
        error_m.append(float(np.linalg.norm(joints[0] - joints[1], axis=-1).mean()))
    assert error_m[1] < error_m[0] + 0.0003
    assert error_m[1] != error_m[0]


def test_sampled_frames_are_interpolated(scene):
    truth, problem = scene
    pose = get_poses(truth)
    model = load_pose_model("autoencoder", BODY.skeleton)
    every, some = build_term(model, problem, pose), build_term(model, problem, pose, frames=np.r_[0:119:6, 119])
    # The network computes in single precision, and rounds differently in batches of another size.
    np.testing.assert_allclose(some.rotations[::6], every.rotations[::6], atol=1e-4)
    free = np.flatnonzero(BODY.free_joints)[1:]
    difference = Rotation.from_matrix(
        (some.rotations @ np.swapaxes(every.rotations, 2, 3))[:, free].reshape(-1, 3, 3)
    ).magnitude()
    assert np.median(difference) < 0.05


def test_unobserved_and_fixed_joints_keep_the_mean_pose(scene):
    truth, problem = scene
    hidden = np.zeros((len(truth.motion.root_position), JOINTS), bool)
    hidden[10:20, LEFT] = True
    conditioner = PriorConditioner(lambda: load_pose_model("autoencoder", BODY.skeleton), 1.0)
    term = set_frame_prior(replace(problem, is_unobserved=hidden), conditioner, get_poses(truth)).pose_problem.pose_prior
    fixed, base = ~BODY.free_joints, problem.pose_problem.pose_prior
    np.testing.assert_array_equal(
        term.rotations[:, fixed], np.broadcast_to(base.rotations[0, fixed], term.rotations[:, fixed].shape)
    )
    np.testing.assert_array_equal(term.rotations[15, LEFT], base.rotations[0, LEFT])
    assert not np.allclose(term.rotations[30, LEFT], base.rotations[0, LEFT])

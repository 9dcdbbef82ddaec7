"""The trained prior in every frame: joints that markers determine keep their poses, the others follow the rest of the body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import pipeline
from mocapfix.contacts.contacts import CONTACT_JOINTS
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, mean_pose, pose_problem, prior_conditioner
from mocapfix.solve.pose_prior import GaussianModel
from mocapfix.solve.prior_conditioner import PriorConditioner, apply_pose_prior
from mocapfix.solve.terms import MarkerAttachment
from mocapfix.solve.trained_priors import load_pose_model
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
NAMES, JOINTS = BODY.skeleton.names, len(BODY.skeleton.names)
LEFT, RIGHT = NAMES.index("LeftForeArm"), NAMES.index("RightForeArm")
FEET = np.array([NAMES.index("LeftFoot"), NAMES.index("RightFoot")])
PRIOR, LIMITS = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), mean_pose.load_joint_limits(BODY.skeleton)
FREE_AXES = replace(PRIOR, locked_information=np.zeros_like(PRIOR.locked_information))


@pytest.fixture(scope="module")
def scene():
    """Return a composed take, and the problem of its true poses."""
    truth = compose_take(seed=4, seconds=2.0, rate=60.0)
    take = Take(truth.marker_positions, truth.labels, 60.0)
    return truth, pose_problem.build_motion_problem(take, truth.subject, BODY, PRIOR, LIMITS, SolveOptions()).pose_problem


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


def hide_left_forearm(truth, problem):
    """Return a problem without the markers that the left forearm moves."""
    shown = ~prior_conditioner.find_moved_joints(BODY.skeleton.parents)[LEFT, truth.subject.joints]
    return replace(problem, attachment=MarkerAttachment(*(each[shown] for each in problem.attachment)))


def test_undetermined_joint_follows_the_rest_of_the_body(scene):
    truth, problem = scene
    pose = get_poses(truth)
    hidden = hide_left_forearm(truth, problem)
    model, frames = copy_right_forearm(), np.arange(len(pose[0]))
    term = prior_conditioner.build_frame_prior_term(model, 1e-3, hidden, FREE_AXES, pose, frames)
    difference = Rotation.from_matrix(term.rotations[:, LEFT] @ np.swapaxes(pose[1][:, RIGHT], 1, 2)).magnitude()
    assert np.median(difference) < 0.1


def test_undetermined_joint_is_posed_and_held_joints_stay(scene):
    truth, problem = scene
    pose = get_poses(truth)
    without_limits = replace(problem, joint_limits=problem.joint_limits._replace(weight=0.0))
    conditioner = PriorConditioner(copy_right_forearm, 1.0)
    found = apply_pose_prior(hide_left_forearm(truth, without_limits), FREE_AXES, conditioner, pose, FEET, 60.0)
    before, after = (
        Rotation.from_matrix(each[:, LEFT] @ np.swapaxes(each[:, RIGHT], 1, 2)).magnitude() for each in (pose[1], found[1])
    )
    assert np.median(after) < 0.5 * np.median(before)
    positions = [kinematics.compute_tree_poses(problem.tree, *each)[0] for each in (pose, found)]
    moved = np.linalg.norm(positions[1] - positions[0], axis=-1)
    assert moved[:, FEET].max() < 5e-4
    assert moved.max() > 0.01


def test_well_seen_frames_are_not_biased(scene):
    truth, problem = scene
    conditioner = PriorConditioner(lambda: load_pose_model("autoencoder", BODY.skeleton), 1.0)
    nothing = np.zeros(0, int)
    found = apply_pose_prior(problem, PRIOR, conditioner, get_poses(truth), nothing, 60.0)
    joints = [kinematics.compute_tree_poses(problem.tree, *each)[0] for each in (found, get_poses(truth))]
    error_m = np.linalg.norm(joints[0] - joints[1], axis=-1)
    assert 0 < error_m.mean() < 0.003


def test_motion_has_the_prior_and_fills_and_feet_do_not(brief):
    with_prior, without = (
        pipeline.clean(brief.path, subject=brief.subject, prior_scope=scope) for scope in ("every-frame", "lost-limbs")
    )
    np.testing.assert_array_equal(with_prior.take.markers, without.take.markers)
    assert with_prior.joint_position_world is not None
    assert without.joint_position_world is not None
    assert with_prior.motion is not None
    moved_m = np.linalg.norm(with_prior.joint_position_world - without.joint_position_world, axis=-1)
    assert moved_m[:, [NAMES.index(name) for name in CONTACT_JOINTS]].max() < 5e-4
    assert moved_m.max() > 1e-3
    rotations = with_prior.motion.local_rotations
    identity = np.broadcast_to(np.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(-1, -2), identity, atol=1e-9)


def test_a_take_of_one_frame_has_a_prior(scene):
    truth, problem = scene
    conditioner = PriorConditioner(lambda: load_pose_model("autoencoder", BODY.skeleton), 1.0)
    pose = tuple(each[:1] for each in get_poses(truth))
    found = apply_pose_prior(problem, PRIOR, conditioner, pose, FEET, 60.0)
    assert [each.shape for each in found] == [(1, 3), (1, JOINTS, 3, 3)]
    assert np.isfinite(found[1]).all()


def test_sampled_frames_are_interpolated(scene):
    truth, problem = scene
    pose = get_poses(truth)
    model = load_pose_model("autoencoder", BODY.skeleton)
    every, some = (
        prior_conditioner.build_frame_prior_term(model, 1e-3, problem, PRIOR, pose, frames)
        for frames in (np.arange(120), np.r_[0:119:6, 119])
    )
    # The network computes in single precision, and rounds differently in batches of another size.
    np.testing.assert_allclose(some.rotations[::6], every.rotations[::6], atol=1e-4)
    free = np.flatnonzero(BODY.free_joints)[1:]
    difference = Rotation.from_matrix(
        (some.rotations @ np.swapaxes(every.rotations, 2, 3))[:, free].reshape(-1, 3, 3)
    ).magnitude()
    assert np.median(difference) < 0.05


def test_fixed_joints_keep_the_mean_pose(scene):
    truth, problem = scene
    model, pose = load_pose_model("autoencoder", BODY.skeleton), get_poses(truth)
    term = prior_conditioner.build_frame_prior_term(model, 1.0, problem, PRIOR, pose, np.arange(0, 120, 7)[:17])
    fixed, base = ~BODY.free_joints, problem.pose_prior
    expected = np.broadcast_to(base.rotations[0, fixed], term.rotations[:, fixed].shape)
    np.testing.assert_allclose(term.rotations[:, fixed], expected, atol=1e-12)

"""The trained priors of the motion: joints that markers determine keep their poses, the others follow the rest of the body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import pipeline
from mocapfix.contacts.contacts import CONTACT_JOINTS
from mocapfix.model.motion import PoseEvidence
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, mean_pose, motion_solver, occluded_joints, pose_problem, prior_conditioner
from mocapfix.solve.motion_prior import GapPrediction
from mocapfix.solve.pose_prior import GaussianModel
from mocapfix.solve.prior_conditioner import PriorConditioner, apply_pose_prior
from mocapfix.solve.terms import MarkerAttachment
from mocapfix.solve.trained_priors import load_pose_model
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d

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


ARM = [NAMES.index(f"Left{name}") for name in ("Arm", "ForeArm", "Hand")]
LEG = [NAMES.index(f"Right{name}") for name in ("UpLeg", "Leg", "Foot")]
LOST = slice(60, 120)


def hide_limbs(markers, subject, joints=(*ARM, *LEG), frames=LOST):
    """Return markers of which those on some joints are missing in some frames."""
    hidden = markers.copy()
    hidden[frames, np.isin(subject.joints, joints)] = np.nan
    return hidden


def test_lost_limbs_have_the_motion_prior(monkeypatch):
    truth = compose_take(seed=4, seconds=3.0, rate=60.0)
    take = Take(hide_limbs(truth.marker_positions, truth.subject), truth.labels, 60.0)
    problem = pose_problem.build_motion_problem(take, truth.subject, BODY, PRIOR, LIMITS, SolveOptions())
    inferred, frame_count = truth.motion.local_rotations.copy(), len(take.markers)
    inferred[LOST, [*ARM, *LEG]] @= Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    motion = replace(truth.motion, local_rotations=inferred)
    variance = np.full((frame_count, JOINTS), 0.04)
    evidence = PoseEvidence(np.zeros(take.visible.shape), variance, variance, np.zeros(frame_count))
    sizes = set()

    def predict(context, size_ratio):  # the first frame of the context is that of the take
        sizes.add(size_ratio)
        rotations = truth.motion.local_rotations[context.frames]
        variance = np.full(rotations.shape[:2], 0.02)
        return GapPrediction(rotations, variance, context.root_position[context.frames], np.ones(len(rotations)))

    monkeypatch.setattr(occluded_joints, "predict_shipped_gap", predict)
    found = motion_solver.add_motion_prior(problem, motion, evidence)
    turned = Rotation.from_matrix((truth.motion.local_rotations.swapaxes(-1, -2) @ found.local_rotations).reshape(-1, 3, 3))
    error_rad = turned.magnitude().reshape(frame_count, JOINTS)
    np.testing.assert_allclose(error_rad[LOST, [*ARM, *LEG]], 0.15, atol=1e-6)  # half of the weight
    is_lost = np.zeros((frame_count, JOINTS), bool)
    is_lost[LOST, [*ARM, *LEG]] = True
    assert (found.local_rotations == inferred)[~is_lost].all()
    assert (found.root_position == motion.root_position).all()
    assert sizes == {truth.subject.skeleton.size_ratio}


def test_limbs_lost_together_with_the_body_do_not_jump():
    """The motion prior is not used where the body is lost before the limb is seen again: no known pose ends the gap."""
    truth, with_body = compose_take(seed=4, seconds=3.0, rate=60.0), slice(60, 90)
    markers = hide_limbs(truth.marker_positions, truth.subject, ARM)
    markers[with_body.stop : LOST.stop] = np.nan
    problem = pose_problem.build_motion_problem(
        Take(markers, truth.labels, 60.0), truth.subject, BODY, PRIOR, LIMITS, SolveOptions()
    )
    local_rotations, frame_count = truth.motion.local_rotations.copy(), len(markers)
    local_rotations[LOST, ARM] @= Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    motion, variance = replace(truth.motion, local_rotations=local_rotations), np.full((frame_count, JOINTS), 0.04)
    evidence = PoseEvidence(np.zeros(markers.shape[:2]), variance, variance, np.zeros(frame_count))
    found = motion_solver.add_motion_prior(problem, motion, evidence)
    step, before = (
        Rotation.from_matrix((each[89:90, ARM].swapaxes(-1, -2) @ each[90:91, ARM])[0]).magnitude()
        for each in (found.local_rotations, local_rotations)
    )
    np.testing.assert_allclose(step, before, atol=0.02)


def test_motion_and_fills_of_lost_limbs_have_the_motion_prior_and_deviations_do_not(cleaned, tmp_path, monkeypatch):
    truth, subject, path = cleaned.truth, cleaned.result.subject, tmp_path / "lost.c3d"
    path.write_bytes(build_c3d(hide_limbs(truth.marker_positions[:180], truth.subject, ARM), truth.labels))
    with_prior = pipeline.clean(path, subject=subject, prior_scope="lost-limbs")
    monkeypatch.setattr(occluded_joints, "predict_shipped_gap", lambda *_: None)
    without = pipeline.clean(path, subject=subject, prior_scope="lost-limbs")
    is_filled = (with_prior.take.markers != without.take.markers).any(2)
    assert is_filled.any()
    assert set(np.flatnonzero(is_filled.any(1))) <= set(range(LOST.start, LOST.stop))
    assert with_prior.motion is not None
    assert without.motion is not None
    np.testing.assert_array_equal(with_prior.motion.joint_sd, without.motion.joint_sd)
    is_moved = (with_prior.motion.local_rotations != without.motion.local_rotations).any((2, 3))
    assert set(np.flatnonzero(is_moved.any(0))) == set(ARM)
    assert set(np.flatnonzero(is_moved.any(1))) <= set(range(LOST.start, LOST.stop))


def test_without_a_prior_no_limb_has_one(cleaned, tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("the motion prior was used")

    monkeypatch.setattr(occluded_joints, "predict_shipped_gap", refuse)
    truth, path = cleaned.truth, tmp_path / "lost.c3d"
    path.write_bytes(build_c3d(hide_limbs(truth.marker_positions[:180], truth.subject, ARM), truth.labels))
    pipeline.clean(path, subject=cleaned.result.subject, prior_scope="none")

"""Predicted standard deviations: the marker error, and joints of a known body."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, mean_pose, motion_solver
from mocapfix.solve.motion_solver import (
    MIN_ESTIMATED_MARKER_SD_M,
    compute_pose_sd,
    compute_unsolved_joint_variance,
    estimate_actual_marker_sd,
    estimate_marker_sd,
)
from mocapfix.solve.pose_problem import PoseProblem
from mocapfix.solve.terms import (
    KinematicTree,
    MarkerAttachment,
    build_no_joint_limits,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
NAMES = BODY.skeleton.names


@pytest.mark.parametrize("absorbed", [0.0, 0.3, 0.8])
def test_absorbed_marker_errors_are_corrected(absorbed):
    residual = np.random.default_rng(0).normal(0, 0.005 * np.sqrt(1 - absorbed), (400, 40, 3))
    distance = np.linalg.norm(residual, axis=-1)
    distance[:20] = 0.3  # outliers
    share, all_usable = np.full(distance.shape, absorbed), np.ones(distance.shape, bool)
    assert estimate_marker_sd(distance, share, all_usable, 0.01) == pytest.approx(0.005, rel=0.07)
    distance[:, 0], share[:, 0] = 0.0, 1.0  # a marker that the pose follows wholly
    usable = all_usable.copy()
    usable[:, 0] = False
    assert estimate_marker_sd(distance, share, usable, 0.01) == pytest.approx(0.005, rel=0.07)


def test_default_sd_without_usable_markers_and_lower_bound():
    some = np.zeros((3, 2))
    assert estimate_marker_sd(some, some, np.zeros((3, 2), bool), 0.01) == 0.01
    assert estimate_marker_sd(some, some, np.ones((3, 2), bool), 0.01) == MIN_ESTIMATED_MARKER_SD_M


@pytest.fixture(scope="module")
def scene():
    """Return a subject, its motion and a problem: markers with noise of 4 mm per axis, those of the left hand unused."""
    truth = compose_take(seed=101, seconds=2.0, rate=60.0)
    subject = truth.subject
    solver_mask = np.ones(truth.missing_mask.shape, bool)
    solver_mask[:, np.isin(subject.joints, [NAMES.index("LeftForeArm"), NAMES.index("LeftHand")])] = False
    noise = np.random.default_rng(1).normal(0, 0.004, truth.marker_positions.shape)
    tree = KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, BODY.free_joints)
    problem = PoseProblem(
        tree,
        MarkerAttachment(subject.joints, subject.marker_offsets),
        truth.marker_positions + noise,
        solver_mask,
        0.01,
        build_pose_prior_term(MEAN.scale_information(0.01)),
        build_no_joint_limits(31),
    )
    return subject, truth.motion, problem


def predict_sd(scene, tracking_sd=None, subject=None):
    person, motion, problem = scene
    time = build_no_tracking(31)
    if tracking_sd is not None:
        weight = np.zeros((1, 31))
        weight[0, [NAMES.index("LeftForeArm"), NAMES.index("LeftHand")]] = 1 / tracking_sd**2
        time = time._replace(rotations=motion.local_rotations[:1], weight=weight)
    pose = motion.root_position, motion.local_rotations
    nominal_sd = problem.compute_uncertainty(pose, 0.05).marker_sd
    marker_sd = estimate_actual_marker_sd(problem, pose, person, nominal_sd)
    return compute_pose_sd(problem, pose, subject or person, MEAN, marker_sd, time, 0.05)


def test_joint_without_markers_is_less_certain_and_tracking_helps(scene):
    _, untracked = predict_sd(scene)
    _, tracked = predict_sd(scene, tracking_sd=0.1)
    lost, seen = NAMES.index("LeftHand"), NAMES.index("RightHand")
    assert untracked.shape == (scene[1].frame_count, 31)
    assert (untracked[:, lost] > 10 * untracked[:, seen]).all()
    assert (tracked[:, lost] < 0.8 * untracked[:, lost]).all()
    np.testing.assert_allclose(tracked[:, NAMES.index("LeftLeg")], untracked[:, NAMES.index("LeftLeg")], rtol=1e-3)


def test_smaller_marker_errors_give_more_certain_joints(scene):
    subject, motion, problem = scene
    markers = problem.marker_positions - 0.5 * (
        problem.marker_positions - kinematics.compute_joint_and_marker_positions(subject, motion)[1]
    )
    _, half_error = predict_sd((subject, motion, replace(problem, marker_positions=markers)))
    _, full_error = predict_sd(scene)
    knee = NAMES.index("LeftLeg")
    assert np.median(half_error[:, knee] / full_error[:, knee]) == pytest.approx(0.5, abs=0.1)


def test_firm_locked_axes_make_hands_more_certain_but_no_marker(scene, monkeypatch):
    firm_markers, firm_joints = predict_sd(scene)
    monkeypatch.setattr(motion_solver, "LOCKED_INFORMATION_RATIO", 1.0)
    markers, joints = predict_sd(scene)
    np.testing.assert_array_equal(firm_markers, markers)
    assert (firm_joints <= joints * (1 + 1e-9)).all()
    assert (firm_joints[:, NAMES.index("RightFingerBase")] < 0.8 * joints[:, NAMES.index("RightFingerBase")]).all()
    np.testing.assert_allclose(firm_joints[:, NAMES.index("Head")], joints[:, NAMES.index("Head")], rtol=0.01)  # nothing locked


def test_calibration_error_is_added(scene):
    subject, _, _ = scene
    posed_markers, posed_joints = predict_sd(scene)
    uncertain_subject = replace(subject, joint_sd=np.full(31, 0.02), marker_sd=np.full(41, 0.03))
    markers, joints = predict_sd(scene, subject=uncertain_subject)
    np.testing.assert_allclose(joints**2, posed_joints**2 + 0.02**2)
    np.testing.assert_allclose(markers**2, posed_markers**2 + 0.03**2)


def test_index_finger_varies_with_the_unsolved_rotation_of_its_base(scene):
    subject, _, _ = scene
    variance = compute_unsolved_joint_variance(subject, MEAN, BODY.free_joints)
    assert {NAMES[j] for j in np.flatnonzero(variance)} == {"LeftHandIndex1", "RightHandIndex1"}
    base, finger = NAMES.index("LeftFingerBase"), NAMES.index("LeftHandIndex1")
    rng = np.random.default_rng(3)
    vectors = rng.multivariate_normal(np.zeros(3), np.linalg.inv(MEAN.information[base]), 20000)
    shift = np.cross(vectors, subject.skeleton.offsets[finger])
    assert variance[finger] == pytest.approx((shift**2).mean(), rel=0.05)

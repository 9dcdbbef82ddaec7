"""The prediction of hip joints from the landmarks of the pelvis, and what it changes in a calibration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.subject.average_body import scale_subject
from mocapfix.subject.library import load_marker_set
from mocapfix.subject.refinement import (
    HIP_REGRESSION_SD_M,
    CalibrationParameters,
    add_hip_regression,
    build_calibration_parameters,
    build_hip_evidence,
    find_pelvis_landmarks,
    predict_hip_joints,
)

BODY = load_cmu31_body()
PELVIS_M = np.array([[0.12, 0.0, 0.1], [-0.12, 0.0, 0.1], [0.0, 0.0, -0.1]])
"""iliac spines of a pelvis that is 240 mm wide and 200 mm deep, its landmarks at one height: left, right, middle behind"""


def start_of(name: str, ratio: float = 1.0) -> Subject:
    """Return the average body at a size, with the markers of a set."""
    markers = load_marker_set(name)
    offsets = markers.marker_offsets
    body = Subject(BODY.skeleton, markers.name, markers.labels, markers.joints, offsets, markers.marker_spread)
    return scale_subject(body, ratio)


def parameters_of(start: Subject) -> CalibrationParameters:
    prior = load_mean_pose_prior("mean-pose", BODY.skeleton)
    return add_hip_regression(build_calibration_parameters(start, BODY, prior), start)


def compute_error(start: Subject, parameters: CalibrationParameters, unknowns: np.ndarray) -> np.ndarray:
    """Return the hip joints of a body, relative to those predicted from its landmarks, in metres."""
    offsets, markers, _ = parameters.compute_body(unknowns)
    landmarks = find_pelvis_landmarks(start)
    assert landmarks is not None
    hips = offsets[[BODY.skeleton.find_joint(name) for name in ("LeftUpLeg", "RightUpLeg")]]
    left, right = landmarks[:2]
    return (hips - predict_hip_joints(markers[left], markers[right], markers[list(landmarks.posterior)].mean(0))).ravel()


def test_known_pelvis():
    """0.33 x 240 + 7.3 mm to the side, 0.30 x 240 + 10.9 mm down, 0.24 x 200 + 9.9 mm back (Harrington et al. 2007)."""
    left, right = predict_hip_joints(*PELVIS_M)
    np.testing.assert_allclose(left, [0.0865, -0.0829, 0.0421], atol=1e-12)
    np.testing.assert_allclose(right, [-0.0865, -0.0829, 0.0421], atol=1e-12)


def test_prediction_turns_with_the_pelvis():
    turn, shift = Rotation.from_rotvec([0.4, -1.2, 0.7]), np.array([1.0, 2.0, 3.0])
    moved = predict_hip_joints(*(turn.apply(PELVIS_M) + shift))
    np.testing.assert_allclose(moved, turn.apply(predict_hip_joints(*PELVIS_M)) + shift, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("plug-in-gait39", ("LASI", "RASI", "LPSI", "RPSI")),
        ("davis", ("l asis", "r asis", "sacrum")),
        ("cmu41", None),
        ("frontwaist53", None),
    ],
)
def test_landmarks_are_found_at_any_size(name, labels):
    for ratio in (0.6, 1.1):
        subject = start_of(name, ratio)
        landmarks = find_pelvis_landmarks(subject)
        found = landmarks and tuple(subject.labels[k] for k in (*landmarks[:2], *landmarks.posterior))
        assert found == labels


def test_sets_without_landmarks_keep_their_prior():
    start = start_of("cmu41")
    parameters = parameters_of(start)
    assert not parameters.expected.any()
    assert add_hip_regression(parameters, start) is parameters


def test_derivatives_are_those_of_the_error():
    start = start_of("plug-in-gait39", 0.9)
    parameters = parameters_of(start)
    evidence = build_hip_evidence(start, parameters)
    assert evidence is not None
    np.testing.assert_allclose(evidence[0], compute_error(start, parameters, np.zeros(len(parameters.information))))
    rng = np.random.default_rng(0)
    for _ in range(5):
        direction = rng.normal(0, 0.001, len(parameters.information))
        change = compute_error(start, parameters, direction) - compute_error(start, parameters, -direction)
        np.testing.assert_allclose(change / 2, evidence[1] @ direction, atol=1e-6)


def expect(parameters: CalibrationParameters, known: dict[int, float]) -> np.ndarray:
    """Return the unknowns that the prior expects where some of them are known, as a take determines the size."""
    unknowns, indices = parameters.expected.copy(), np.array(list(known))
    unknowns[indices] = list(known.values())
    others = np.setdiff1d(np.arange(len(unknowns)), indices)
    coupling = parameters.information[np.ix_(others, indices)] @ (unknowns - parameters.expected)[indices]
    unknowns[others] -= np.linalg.solve(parameters.information[np.ix_(others, others)], coupling)
    return unknowns


def test_expected_body_agrees_better_with_the_prediction():
    start = start_of("plug-in-gait39")
    parameters = parameters_of(start)
    unknowns = expect(parameters, {0: 0.0})
    before, after = (np.abs(compute_error(start, parameters, x)).max() for x in (np.zeros(len(unknowns)), unknowns))
    assert before > HIP_REGRESSION_SD_M
    assert after < before / 2


def test_narrow_pelvis_has_near_hip_joints():
    """0.33 of the distance by which the iliac spines are nearer, or less: the joints have a prior of their own, too."""
    start, left = start_of("plug-in-gait39"), BODY.skeleton.find_joint("LeftUpLeg")
    landmarks, parameters = find_pelvis_landmarks(start), parameters_of(start)
    assert landmarks is not None
    first_shift = len(parameters.deformations.marker_offsets)
    left_x, right_x = (first_shift + 3 * k for k in landmarks[:2])
    usual, narrow = (
        parameters.compute_body(expect(parameters, {0: 0.0, left_x: -nearer_m, right_x: nearer_m})).offsets[left, 0]
        for nearer_m in (0.0, 0.015)
    )
    assert 0.003 < usual - narrow < 0.33 * 0.030


def test_marker_of_another_joint_is_no_landmark():
    start = start_of("plug-in-gait39")
    moved = start.joints.copy()
    moved[start.labels.index("LASI")] = BODY.skeleton.find_joint("LowerBack")
    assert find_pelvis_landmarks(replace(start, joints=moved)) is None

"""Filling from a body with known pose: the residual is interpolated from the edges of the gap."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from mocapfix.fill.body_fill import BODY_ERROR_RATIO, BodyPlacement, PredictedPlacement, estimate_preview
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.motion import PoseEvidence
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.stats.rigid_alignment import compute_rotations
from mocapfix.synthetic import compose_take
from tests.fill.gap_examples import build_gap, build_take

RATE = 60.0
ARM_LABELS = ("LWRA", "LWRB", "LFIN", "LFRM", "LELB", "LUPA")


@pytest.fixture(scope="module")
def scene():
    """Return subject, motion, the markers (T, K, 3) on the body and world rotations; all markers have the same sd."""
    truth = compose_take(seed=2, seconds=6.0, rate=RATE)
    motion = replace(truth.motion, marker_sd=np.full(truth.missing_mask.shape, 0.004))
    _, rotation = kinematics.compute_world_poses(truth.subject.skeleton, motion)
    return truth.subject, motion, kinematics.compute_joint_and_marker_positions(truth.subject, motion)[1], rotation


def build_body(scene, damaged, motion=None):
    """Return the body of damaged markers (T, K, 3)."""
    subject, known, on_body, _ = scene
    joints = kinematics.compute_joint_and_marker_positions(subject, known)[0]
    columns = np.arange(len(subject.labels))
    return BodyFit(subject, subject, columns, Take(damaged, subject.labels, RATE), motion or known, joints, on_body, None)


def fill(scene, markers, marker, first, last, motion=None):
    """Return the estimate of a marker that is lost over first..last, and its standard deviation at the points of the gap."""
    damaged = markers.copy()
    damaged[first : last + 1, marker] = np.nan
    body = build_body(scene, damaged, motion)
    take = build_take(damaged, rate=RATE, body=body)
    [estimate] = BodyPlacement(take)(build_gap(take, marker, first, last))
    return estimate


@pytest.mark.parametrize(("marker", "first", "last"), [(5, 100, 200), (30, 0, 20), (12, 350, 359)])
def test_marker_at_its_offset_is_exact(scene, marker, first, last):
    estimate = fill(scene, scene[2], marker, first, last)
    np.testing.assert_allclose(estimate.position, scene[2][first : last + 1, marker], atol=1e-9)
    assert (estimate.expected_sd > 0).all()


def test_residual_is_interpolated_in_segment_axes(scene):
    subject, _, on_body, rotation = scene
    k = subject.labels.index("LFRM")
    off = np.einsum("tab,b->ta", rotation[:, subject.joints[k]], [0.015, -0.01, 0.005])
    markers = on_body.copy()
    markers[:, k] += off
    position = fill(scene, markers, k, 150, 155).position  # 0.1 s
    np.testing.assert_allclose(position, markers[150:156, k], atol=0.0015)  # the body alone is 19 mm off
    beyond = np.linalg.norm(fill(scene, markers, k, 100, 300).position - on_body[100:301, k], axis=-1)
    assert beyond[0] > 0.015
    assert beyond[100] < 0.002  # far from measured samples, the fill is the marker on the body


def test_sd_grows_with_the_distance_from_the_edges(scene):
    on_body = scene[2]
    skin = gaussian_filter1d(np.random.default_rng(0).normal(0, 1, on_body.shape), 0.15 * RATE, axis=0)
    estimate = fill(scene, on_body + 0.004 * skin / skin.std(), 7, 100, 250)
    assert (np.diff(estimate.expected_sd[:3]) > 0).all()
    assert (np.diff(estimate.expected_sd[-3:]) < 0).all()
    assert 0.002 < estimate.expected_sd[3] < 0.02  # of the size of the residual itself
    assert 0.5 < np.sqrt((estimate.error[:, 3] ** 2).mean()) / (BODY_ERROR_RATIO * 0.004) < 2


def move_pose(scene, marker, first, last, offset):
    """Return the motion of a body that is away by `offset` (3,) m while a marker is lost, and says so."""
    motion = scene[1]
    marker_sd, root_position = motion.marker_sd.copy(), motion.root_position.copy()
    marker_sd[first : last + 1] = 0.05
    root_position[first : last + 1] += offset
    return replace(motion, marker_sd=marker_sd, root_position=root_position)


def test_uncertain_pose_increases_the_sd_and_the_errors(scene):
    markers = scene[2] + np.random.default_rng(0).normal(scale=0.001, size=scene[2].shape)
    certain = fill(scene, markers, 7, 100, 250)
    uncertain = fill(scene, markers, 7, 100, 250, move_pose(scene, 7, 100, 250, np.zeros(3)))
    assert certain.expected_sd[3] < 0.01
    assert uncertain.expected_sd[3] == pytest.approx(BODY_ERROR_RATIO * 0.05, rel=0.1)
    assert uncertain.expected_sd[0] < 0.3 * uncertain.expected_sd[3]  # the step of the pose is measured at the edges
    assert np.sqrt((uncertain.error[:, 3] ** 2).mean()) == pytest.approx(BODY_ERROR_RATIO * 0.05, rel=0.1)
    assert uncertain.evidence < 0.1 < certain.evidence


def test_step_of_the_pose_is_removed_at_the_edges(scene):
    """A body that jumps by 30 mm where the marker is lost."""
    motion = move_pose(scene, 7, 100, 250, np.array([0.03, 0.0, 0.0]))
    error = np.linalg.norm(fill(scene, scene[2], 7, 100, 250, motion).position - scene[2][100:251, 7], axis=1)
    assert error[[0, -1]].max() < 0.004
    assert error[75] > 0.02  # far from the edges nothing is known of it


def test_invisible_marker_is_placed_at_its_offset(scene):
    estimate = fill(scene, scene[2], 9, 0, len(scene[2]) - 1)
    np.testing.assert_allclose(estimate.position, scene[2][:, 9], atol=1e-9)
    assert (estimate.expected_sd >= 0.004).all()


def test_marker_that_is_not_on_the_body_has_no_estimate():
    take = build_take(np.random.default_rng(0).normal(size=(50, 3, 3)))
    assert BodyPlacement(take)(build_gap(take, 0, 10, 20)) == []


def test_preview_carries_the_residual_across_a_gap_and_leaves_segments_that_no_marker_shows(scene):
    subject, motion, on_body, rotation = scene
    markers, marker_sd = on_body.copy(), motion.marker_sd.copy()
    marker, unseen = subject.labels.index("LFRM"), subject.labels.index("RKNE")
    markers[:, marker] += np.einsum("tab,b->ta", rotation[:, subject.joints[marker]], [0.015, -0.01, 0.005])
    damaged = markers.copy()
    damaged[100:200, [marker, unseen]] = damaged[:20, marker] = np.nan
    marker_sd[150, unseen] = 0.05
    body = build_body(scene, damaged, replace(motion, marker_sd=marker_sd))
    position, sd, _ = estimate_preview(damaged, RATE, body)
    is_lost = np.isnan(damaged[..., 0])
    np.testing.assert_allclose(position[is_lost[:, marker], marker], markers[is_lost[:, marker], marker], atol=1e-9)
    assert (sd[is_lost[:, marker], marker] > 0).all()
    assert np.isnan(position[100:200, unseen]).all()


def predict(scene, first, lost_labels=ARM_LABELS, *, has_motion_prior=True, turned_rad=0.0, pose_sd_m=0.0):
    """Return the estimator and the gap of a wrist from a frame on in which an arm is lost, its joints turned by an angle.

    Its pose says how uncertain it is.
    """
    subject, motion, on_body, _ = scene
    lost, frames = [subject.labels.index(label) for label in lost_labels], slice(first, first + 30)
    damaged, local_rotations = on_body.copy(), motion.local_rotations.copy()
    damaged[frames, lost] = np.nan
    hidden = np.unique(subject.joints[lost])
    local_rotations[frames, hidden] @= compute_rotations(np.array([turned_rad, 0.0, 0.0]))
    marker_sd = motion.marker_sd.copy()
    marker_sd[frames, lost] = np.maximum(marker_sd[frames, lost], pose_sd_m)
    body = build_body(scene, damaged, replace(motion, local_rotations=local_rotations, marker_sd=marker_sd))
    nothing = np.zeros((len(damaged), 1))
    evidence = PoseEvidence(nothing, nothing, nothing, nothing[:, 0])
    take = build_take(damaged, rate=RATE, body=replace(body, evidence=evidence, has_motion_prior=has_motion_prior))
    return PredictedPlacement(take), build_gap(take, lost[0], first, first + 29)


def test_motion_prior_is_tried_in_hidden_stretches_as_in_the_gap(scene):
    estimator, gap = predict(scene, 40)
    [estimate] = estimator(gap)
    assert np.linalg.norm(estimate.position - scene[2][gap.window.gap_frames, gap.marker], axis=1).max() > 0.001
    elsewhere, there = predict(scene, int(gap.window.starts[-1]))
    [expected] = elsewhere(there)
    truth = scene[2][there.window.gap_frames, gap.marker]
    error = (expected.position - truth)[there.window.points]
    np.testing.assert_allclose(estimate.error[-1], BODY_ERROR_RATIO * error, atol=1e-6)
    assert np.isnan(estimate.error).any((1, 2)).sum() == len(estimate.error) - 4
    assert (estimate.expected_sd >= np.sqrt(np.nanmean(estimate.error**2))).all()
    estimator, gap = predict(scene, 40, pose_sd_m=0.3)
    assert 0.2 < estimator(gap)[0].expected_sd[3] < 0.3  # no more than the inferred pose says


def test_what_else_is_known_of_hidden_joints_does_not_matter_to_the_motion_prior(scene):
    (estimator, gap), (turned, same) = predict(scene, 40), predict(scene, 40, turned_rad=0.5)
    np.testing.assert_allclose(turned(same)[0].position, estimator(gap)[0].position, atol=1e-9)


@pytest.mark.parametrize("fields", [{"has_motion_prior": False}, {"lost_labels": ARM_LABELS[:1]}])
def test_motion_prior_estimates_hidden_limbs_only(scene, fields):
    estimator, gap = predict(scene, 40, **fields)
    assert estimator(gap) == []

"""Calibration of a person from a take with gaps and without a T-pose."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.errors import TakeError
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import kinematics, mean_pose
from mocapfix.subject import average_body, calibration
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)


def lengths(skeleton):
    return np.linalg.norm(skeleton.offsets, axis=1)


def calibrate(markers, labels=MARKER_SET.labels, rate=30.0):
    return calibration.fit_calibration(Take(markers, labels, rate), MARKER_SET, BODY, MEAN).subject


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=1, seconds=9.0, rate=20.0)


@pytest.fixture(scope="module")
def found(truth):
    return calibrate(np.where((truth.missing_mask | truth.spike_mask)[..., None], np.nan, truth.marker_positions))


def test_calibration_reduces_bone_and_marker_errors(truth, found):
    def off(skeleton):
        return np.sqrt(((lengths(skeleton) - lengths(truth.subject.skeleton)) ** 2).mean())

    assert off(found.skeleton) < 0.7 * off(BODY.skeleton)
    places = np.linalg.norm(found.marker_offsets - truth.subject.marker_offsets, axis=1).mean()
    assert places < 0.75 * np.linalg.norm(MARKER_SET.marker_offsets - truth.subject.marker_offsets, axis=1).mean()


def test_calibrated_subject_has_the_marker_set_and_skeleton(found):
    assert (found.marker_set, found.labels) == (MARKER_SET.name, MARKER_SET.labels)
    np.testing.assert_array_equal(found.joints, MARKER_SET.joints)
    assert found.skeleton.names == BODY.skeleton.names
    np.testing.assert_array_equal(found.skeleton.parents, BODY.skeleton.parents)
    assert found.frame_count == 150
    limbs = [j for j, name in enumerate(BODY.skeleton.names) if name.endswith(("LeftLeg", "RightLeg", "ForeArm", "Hand"))]
    along = (found.skeleton.offsets * BODY.skeleton.offsets).sum(1)[limbs]  # limbs lie along their own axes
    np.testing.assert_allclose(along, (lengths(found.skeleton) * lengths(BODY.skeleton))[limbs], rtol=1e-6)


def test_calibration_is_deterministic(truth, found):
    again = calibrate(np.where((truth.missing_mask | truth.spike_mask)[..., None], np.nan, truth.marker_positions))
    np.testing.assert_array_equal(again.skeleton.offsets, found.skeleton.offsets)
    np.testing.assert_array_equal(again.marker_offsets, found.marker_offsets)


@pytest.mark.parametrize("factor", [0.6, 1.25])
def test_very_small_and_large_subjects_are_calibrated(truth, factor):
    skeleton = replace(BODY.skeleton, offsets=BODY.skeleton.offsets * factor, ends=BODY.skeleton.ends * factor)
    subject = replace(truth.subject, skeleton=skeleton, marker_offsets=MARKER_SET.marker_offsets * factor)
    motion = replace(truth.motion, root_position=truth.motion.root_position * factor)
    found = calibrate(kinematics.compute_joint_and_marker_positions(subject, motion)[1])
    np.testing.assert_allclose(lengths(found.skeleton), lengths(skeleton), atol=0.016)
    np.testing.assert_allclose(found.skeleton.ends, skeleton.ends, rtol=0.06)


def test_scaling_changes_all_lengths():
    whole = average_body.build_average_subject(MARKER_SET)
    half = average_body.scale_subject(whole, 0.5)
    np.testing.assert_allclose(half.skeleton.offsets, whole.skeleton.offsets / 2)
    np.testing.assert_allclose(half.skeleton.ends, whole.skeleton.ends / 2)
    np.testing.assert_allclose(half.marker_offsets, whole.marker_offsets / 2)


def test_take_without_three_markers_is_rejected():
    markers = np.full((20, 41, 3), np.nan)
    markers[:, :2] = 1.0
    with pytest.raises(TakeError, match="the take: no frame shows three markers of the body, so it cannot be calibrated"):
        calibrate(markers)


@pytest.mark.parametrize("frames", [1, 2, 12])
def test_few_frames_give_a_plausible_body(truth, frames):
    found = calibrate(truth.marker_positions[60 : 60 + frames])
    assert found.frame_count == frames
    np.testing.assert_allclose(lengths(found.skeleton), lengths(truth.subject.skeleton), rtol=0.25, atol=0.01)
    assert np.isfinite(found.marker_spread).all()


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_body_of_size_zero_is_rejected(truth, noise):
    cloud = np.random.default_rng(0).normal(0, 1, truth.marker_positions.shape) * noise + [0, 1, 0]
    with pytest.raises(TakeError, match=r"too near together for a person; check the unit \(--unit\)"):
        calibrate(cloud)


def test_next_round_goes_on_from_the_calibration_before(truth, monkeypatch):
    monkeypatch.setattr(calibration, "MAX_KEPT_IMPROVEMENT", -1.0)
    markers = np.where((truth.missing_mask | truth.spike_mask)[..., None], np.nan, truth.marker_positions)
    first = calibration.fit_calibration(Take(markers, MARKER_SET.labels, 30.0), MARKER_SET, BODY, MEAN)
    fewer = markers.copy()
    fewer[np.random.default_rng(0).random(markers.shape[:2]) < 0.02] = np.nan
    take = Take(fewer, MARKER_SET.labels, 30.0)
    again = calibration.update_calibration(take, BODY, MEAN, first)
    cold = calibration.fit_calibration(take, MARKER_SET, BODY, MEAN)
    np.testing.assert_array_equal(again.frames, first.frames)
    assert (again.subject.marker_offsets != first.subject.marker_offsets).any()
    for one, other in ((again, first), (again, cold)):
        assert np.abs(lengths(one.subject.skeleton) - lengths(other.subject.skeleton)).max() < 2e-3
        assert np.linalg.norm(one.subject.marker_offsets - other.subject.marker_offsets, axis=1).mean() < 2e-3


def test_calibration_is_kept_if_samples_hardly_change_it():
    markers = compose_take(seed=7, seconds=8.0, rate=30.0).marker_positions
    take = Take(markers, MARKER_SET.labels, 30.0)
    first = calibration.fit_calibration(take, MARKER_SET, BODY, MEAN)
    elsewhere, within, moved = markers.copy(), markers.copy(), markers.copy()
    elsewhere[np.setdiff1d(np.arange(len(markers)), first.frames)[0], 3] = np.nan
    within[first.frames[0], 3] = np.nan
    moved[:, 3] += [0.0, 0.03, 0.0]
    for changed, is_kept in ((elsewhere, True), (within, True), (moved, False)):
        updated = calibration.update_calibration(Take(changed, MARKER_SET.labels, 30.0), BODY, MEAN, first)
        assert (updated is first) == is_kept

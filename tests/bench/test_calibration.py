"""The measure of calibration, on bodies whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import calibration
from mocapfix.pose_prior import mean_pose
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take

BODY = load_cmu31_body()
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)


@pytest.fixture(scope="module")
def truth():
    return synthetic.compose_take(2, 2.0, 30.0, asymmetric=True)


def measured(truth, subject):
    return calibration.compute_calibration_errors(truth, Take(truth.markers, truth.labels, truth.rate), subject, BODY, MEAN)


def test_the_truth_has_no_error_but_that_of_the_poses(truth):
    found = measured(truth, truth.subject)
    assert found["bones_mm"] == found["places_mm"] == 0
    assert found["joints_mm"] < 8  # skin slides by 4 mm an axis


def test_markers_put_elsewhere_take_the_joints_along(truth):
    there = replace(truth.subject, places=truth.subject.places + [0.012, 0.016, 0.0])
    found = measured(truth, there)
    assert found["places_mm"] == pytest.approx(20.0)
    assert found["joints_mm"] > measured(truth, truth.subject)["joints_mm"] + 3


def test_bones_too_long_are_measured_in_length_and_stubs_are_no_bones():
    longer = replace(BODY.skeleton, offsets=1.1 * BODY.skeleton.offsets)
    lengths = np.linalg.norm(BODY.skeleton.offsets, axis=1)
    assert calibration.compute_bone_length_error(longer, BODY.skeleton) == pytest.approx(
        0.1 * lengths[lengths > calibration.MIN_COMPARED_BONE_LENGTH_M].mean()
    )
    turned = replace(BODY.skeleton, offsets=BODY.skeleton.offsets[:, [1, 2, 0]])
    assert calibration.compute_bone_length_error(turned, BODY.skeleton) == pytest.approx(0.0, abs=1e-12)


def test_there_is_a_row_for_everybody_and_one_of_means_and_calibration_helps():
    rows = calibration.measure_calibration(seeds=(3, 4), duration_s=5.0)
    assert [row["person"] for row in rows] == ["seed 3", "seed 4", "mean"]
    for key in ("bones_mm", "places_mm", "joints_mm", "carrying_mm"):
        one, other, mean = (float(row[key]) for row in rows)
        assert mean == pytest.approx((one + other) / 2)
        assert 0 < mean < float(rows[-1]["average_" + key])
    for key in ("joints_mm", "carrying_mm"):
        mean, true, allowed = (float(rows[-1][prefix + key]) for prefix in ("", "true_", "allowed_"))
        assert true < allowed < 2 * mean  # of two people, one may be luckier than is to be hoped for


def test_what_is_left_open_shrinks_with_the_take_and_with_what_is_known(truth):
    worn = Take(truth.markers, truth.labels, truth.rate)
    short = calibration.compute_irreducible_joint_sd(truth, worn, BODY, MEAN)
    long = synthetic.compose_take(2, 6.0, 30.0, asymmetric=True)
    longer = calibration.compute_irreducible_joint_sd(long, Take(long.marker_positions, long.labels, long.rate), BODY, MEAN)
    firm = replace(
        MEAN,
        information=MEAN.information * 4,
        locked_information=MEAN.locked_information * 4,
        between_take_covariance=MEAN.between_take_covariance / 4,
    )
    assert longer.mean() < short.mean()
    assert (calibration.compute_irreducible_joint_sd(truth, worn, BODY, firm) < short).all()


def test_the_mean_length_of_an_error_is_that_of_a_normal_one():
    drawn = np.random.default_rng(0).normal(size=(100_000, 3))
    assert np.linalg.norm(drawn, axis=1).mean() == pytest.approx(calibration.MEAN_NORMAL_VECTOR_LENGTH, rel=0.01)

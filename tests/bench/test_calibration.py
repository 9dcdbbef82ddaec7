"""The measure of calibration, on bodies whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import prior, synthetic
from mocapfix.bench import calibration
from mocapfix.skeleton import cmu31
from mocapfix.take import Take

BODY = cmu31()
MEAN = prior.load("mean-pose", BODY.skeleton)


@pytest.fixture(scope="module")
def truth():
    return synthetic.take(2, 2.0, 30.0, crooked=True)


def measured(truth, subject):
    return calibration.errors(truth, Take(truth.markers, truth.labels, truth.rate), subject, BODY, MEAN)


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
    assert calibration.bone_error(longer, BODY.skeleton) == pytest.approx(0.1 * lengths[lengths > calibration.BONE].mean())
    turned = replace(BODY.skeleton, offsets=BODY.skeleton.offsets[:, [1, 2, 0]])
    assert calibration.bone_error(turned, BODY.skeleton) == pytest.approx(0.0, abs=1e-12)


def test_there_is_a_row_for_everybody_and_one_of_means_and_calibration_helps():
    rows = calibration.measured(seeds=(3, 4), seconds=5.0)
    assert [row["person"] for row in rows] == ["seed 3", "seed 4", "mean"]
    for key in ("bones_mm", "places_mm", "joints_mm"):
        one, other, mean = (float(row[key]) for row in rows)
        assert mean == pytest.approx((one + other) / 2)
        assert 0 < mean < float(rows[-1]["average_" + key])

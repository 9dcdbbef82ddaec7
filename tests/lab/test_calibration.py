"""The calibration benchmark on bodies with known errors."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.lab import calibration
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import mean_pose
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)


@pytest.fixture(scope="module")
def truth():
    return compose_take(2, 2.0, 30.0, asymmetric=True)


def measure_errors(truth, subject):
    return calibration.compute_calibration_errors(
        truth, Take(truth.marker_positions, truth.labels, truth.rate), subject, BODY, MEAN
    )


def test_true_body_has_pose_errors_only(truth):
    errors = measure_errors(truth, truth.subject)
    assert errors["bones_mm"] == errors["offsets_mm"] == 0
    assert errors["joints_mm"] < 8  # skin motion of 4 mm per axis


def test_wrong_marker_offsets_displace_joints(truth):
    shifted = replace(truth.subject, marker_offsets=truth.subject.marker_offsets + [0.012, 0.016, 0.0])
    errors = measure_errors(truth, shifted)
    assert errors["offsets_mm"] == pytest.approx(20.0)
    assert errors["joints_mm"] > measure_errors(truth, truth.subject)["joints_mm"] + 3


def test_bone_error_is_of_lengths_without_stubs():
    longer = replace(BODY.skeleton, offsets=1.1 * BODY.skeleton.offsets)
    lengths = np.linalg.norm(BODY.skeleton.offsets, axis=1)
    assert calibration.compute_bone_length_error(longer, BODY.skeleton) == pytest.approx(
        0.1 * lengths[lengths > calibration.MIN_COMPARED_BONE_LENGTH_M].mean()
    )
    permuted = replace(BODY.skeleton, offsets=BODY.skeleton.offsets[:, [1, 2, 0]])
    assert calibration.compute_bone_length_error(permuted, BODY.skeleton) == pytest.approx(0.0, abs=1e-12)


def test_each_person_has_a_row_and_calibration_reduces_errors():
    rows = calibration.measure_calibration(seeds=(3, 4), duration_s=5.0)
    assert [row["person"] for row in rows] == ["seed 3", "seed 4", "mean"]
    for key in ("bones_mm", "offsets_mm", "joints_mm", "marked_mm"):
        one, other, mean = (float(row[key]) for row in rows)
        assert mean == pytest.approx((one + other) / 2)
        assert 0 < mean < float(rows[-1]["average_" + key])
    for key in ("joints_mm", "marked_mm"):
        assert float(rows[-1]["true_" + key]) < float(rows[-1][key])

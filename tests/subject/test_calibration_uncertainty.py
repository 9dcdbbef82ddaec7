"""Predicted errors of a calibration: known answers, and errors of simulated estimates."""

import numpy as np
import pytest

from mocapfix.subject.refinement import SKIN_CORRELATION_S, compute_response_sd, compute_shared_covariance


def test_calibration_sd_follows_from_the_covariance():
    markers, joints = np.ones((2, 1, 3, 2)), np.zeros((2, 1, 3, 2))  # both unknowns shift the marker alike
    joints[0, 0, :, 0], joints[1, 0, :, 1] = [3.0, 0, 0], [0, 0, 3.0]  # the first unknown in one frame, the second in the other
    half = np.linalg.cholesky([[0.05, 0.02], [0.02, 0.03]])
    joint_sd, marker_sd = compute_response_sd(joints, half), compute_response_sd(markers, half)
    np.testing.assert_allclose(joint_sd, [np.sqrt((9 * 0.05 + 9 * 0.03) / 6)])
    np.testing.assert_allclose(marker_sd, [np.sqrt(0.05 + 2 * 0.02 + 0.03)])


@pytest.mark.parametrize(("interval_s", "independent_frames"), [(1e3 * SKIN_CORRELATION_S, 50), (1e-6, 1)])
def test_error_of_a_mean_is_that_of_the_independent_frames(interval_s, independent_frames):
    frames, weight, sd = 50, 1e4, 0.004
    response = np.ones((frames, 1, 3, 1))  # the unknown is the marker's distance along (1, 1, 1)
    marker_weight = np.full((frames, 1), weight)
    curvature, information = np.array([[3 * frames * weight]]), np.zeros((1, 1))
    times_s = interval_s * np.arange(frames)
    covariance = compute_shared_covariance(response, marker_weight, np.eye(len(curvature)), curvature, information, times_s, sd)
    assert covariance[0, 0] == pytest.approx(sd**2 / 3 / independent_frames, rel=1e-3)


def test_unmeasured_unknown_varies_as_its_prior():
    response, information, basis = np.zeros((4, 1, 3, 1)), np.array([[25.0]]), np.eye(1)
    covariance = compute_shared_covariance(response, np.ones((4, 1)), basis, information, information, np.arange(4.0), 0.004)
    assert covariance[0, 0] == pytest.approx(0.04)


def test_covariance_is_that_of_simulated_estimates():
    rng = np.random.default_rng(0)
    frames, unknowns, markers, weight, sd, draws = 30, 4, 3, 1e4, 0.004, 4000
    response = rng.normal(size=(frames, markers, 3, unknowns))
    response += rng.normal(size=(markers, 3, unknowns))  # the same in all frames: skin does not average out
    design = response.reshape(-1, unknowns)
    information = np.diag([1e2, 1e3, 1e4, 1e5])
    curvature = weight * design.T @ design + information
    times_s = 0.1 * np.arange(frames)
    marker_weight = np.full((frames, markers), weight)
    predicted = compute_shared_covariance(response, marker_weight, np.eye(len(curvature)), curvature, information, times_s, sd)
    correlation = np.exp(-np.abs(times_s[:, None] - times_s) / SKIN_CORRELATION_S)
    slide = sd * np.einsum("ts,dskc->dtkc", np.linalg.cholesky(correlation), rng.normal(size=(draws, frames, markers, 3)))
    true_unknowns = rng.normal(size=(draws, unknowns)) / np.sqrt(np.diag(information))
    measured = slide.reshape(draws, -1) + true_unknowns @ design.T
    errors = np.linalg.solve(curvature, weight * design.T @ measured.T).T - true_unknowns
    assert np.cov(errors.T) == pytest.approx(predicted, rel=0.15, abs=0.1 * np.diag(predicted).min())
    within = (np.abs(errors) < np.sqrt(np.diag(predicted))).mean(axis=0)
    np.testing.assert_allclose(within, 0.683, atol=4 * np.sqrt(0.683 * 0.317 / draws))

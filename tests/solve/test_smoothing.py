"""Smooth trajectories through uncertain frames."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.motion import PoseUncertainty
from mocapfix.solve import smoothing
from mocapfix.stats.sequences import smooth_path

RATE = 100.0
seeds = st.integers(0, 2**32 - 1)


def draw_random_acceleration_path(rng, seconds, rate, intensity, components=1):
    """Return (T, C) an integrated random acceleration, drawn in twenty steps per frame."""
    fine = 20
    kick = rng.normal(0, np.sqrt(intensity / (rate * fine)), (round(seconds * rate) * fine, components))
    return (np.cumsum(np.cumsum(kick, 0), 0) / (rate * fine))[::fine]


@pytest.mark.parametrize("rate", [60.0, 240.0])
@pytest.mark.parametrize("power", [0.05, 20.0])
def test_power_of_a_random_acceleration_is_estimated(rate, power):
    path = draw_random_acceleration_path(np.random.default_rng(1), 40.0, rate, power, components=3)
    estimated = smoothing.estimate_acceleration_power(path, np.full(len(path), 1e-6), rate, max_sd=0.1)
    assert power < np.median(estimated) / smoothing.PEAK_POWER_RATIO * 2 < 4 * power


def test_fast_stretch_is_distinguished_from_slow_ones():
    t = np.arange(1200) / RATE
    slow, fast = 0.02 * np.sin(2 * np.pi * t), np.where(abs(t - 6) < 1, 0.5 * np.sin(2 * np.pi * 3 * (t - 5)) ** 3, 0)
    estimated = smoothing.estimate_acceleration_power((slow + fast)[:, None], np.full(1200, 1e-6), RATE, 0.1)
    assert np.median(estimated[540:660]) > 20 * np.median(estimated[:450])


def test_uncertain_frames_do_not_affect_the_power():
    rng = np.random.default_rng(2)
    path = draw_random_acceleration_path(rng, 20.0, RATE, 1.0)
    variance, damaged = np.full(len(path), 1e-6), path.copy()
    variance[500:700], damaged[500:700] = 1.0, damaged[500:700] + rng.normal(0, 5.0, (200, 1))
    power_estimate = smoothing.estimate_acceleration_power(damaged, variance, RATE, 0.1).max()
    assert power_estimate < 10 * smoothing.estimate_acceleration_power(path, np.full(len(path), 1e-6), RATE, 0.1).max()
    assert smoothing.estimate_acceleration_power(damaged, np.full(len(path), 1e-6), RATE, 0.1).max() > 10 * power_estimate


def test_steady_rotation_is_a_fixed_point_and_missing_frames_follow_it():
    t = np.arange(200) / RATE
    steady = Rotation.from_rotvec(t[:, None] * [[0.0, 0.8, 0.0]])
    variance, damaged = np.full(200, 1e-4), steady.as_quat()
    variance[90:110], damaged[90:110] = 1e4, [0.0, 0.0, 0.0, 1.0]
    power = smoothing.estimate_rotation_power(damaged, variance, RATE)
    smooth = Rotation.from_quat(smooth_path(damaged, variance, power, RATE))
    assert (smooth * steady.inv()).magnitude().max() < np.radians(1)


def test_interpolated_rotation_has_its_variance():
    t = np.arange(200) / RATE
    steady = Rotation.from_rotvec(t[:, None] * [[0.0, 0.8, 0.0]])
    is_uncertain, damaged = np.zeros(200, bool), steady.as_quat()
    is_uncertain[90:110], damaged[90:110] = True, [0.0, 0.0, 0.0, 1.0]
    smoothed, variance = smoothing.interpolate_quaternions(damaged, is_uncertain, RATE)
    assert (Rotation.from_quat(smoothed) * steady.inv()).magnitude().max() < np.radians(1)
    np.testing.assert_array_equal(variance > 0, is_uncertain)
    assert 99 <= variance.argmax() <= 100  # the middle


def test_gap_variance_is_that_of_an_integrated_random_acceleration():
    is_uncertain, power = np.zeros(100, bool), np.full(100, 2.0)
    is_uncertain[40:59] = is_uncertain[95:] = True
    estimated = smoothing.compute_gap_variance(is_uncertain, power, RATE) / smoothing.GAP_POWER_RATIO
    assert estimated[49] == pytest.approx(2.0 * 0.1**3 / 24)  # a = b = 0.1 s
    assert estimated[-1] == pytest.approx(2.0 * 0.05**3 / 3)  # beyond the last known end
    assert not estimated[~is_uncertain].any()


def test_root_continues_through_missing_frames():
    t = np.arange(200)[:, None] / RATE
    root = t * [[1.2, 0.0, 0.1]]
    variance, damaged = np.full(200, 1e-6), root.copy()
    variance[60:90], damaged[60:90] = 1e4, 0.0
    np.testing.assert_allclose(smoothing.smooth_root_path(damaged, variance, RATE)[0], root, atol=1e-3)


def test_sparsely_known_path_has_finite_power():
    """Three known frames of every 200 give one acceleration, which is too little to estimate the power at any time."""
    frames, rate = 6000, 120.0
    variance = np.ones(frames)
    for lag in (0, 7, 14):
        variance[100 + lag :: 200] = 1e-8
    path = np.random.default_rng(0).normal(size=(frames, 3))
    np.testing.assert_array_equal(smoothing.estimate_acceleration_power(path, variance, rate, 0.01), np.ones(frames))


def draw_strikes(rng, jitter_rad):
    """Return the true angles of a joint in radians that rests, strikes twice within 0.15 s and rests, and (T, 4) with jitter."""
    t = np.arange(300) / RATE
    angle = np.sum([1.5 * np.exp(-(((t - at) / 0.035) ** 2)) for at in (1.2, 2.1)], axis=0)
    rotation = Rotation.from_rotvec(angle[:, None] * [[0.0, 0.6, 0.8]])
    return angle, (Rotation.from_rotvec(rng.normal(0, jitter_rad, (300, 3))) * rotation).as_quat()


def test_jitter_is_removed_from_rest_and_strikes_are_kept():
    angle, measured = draw_strikes(np.random.default_rng(4), 0.004)
    smooth = Rotation.from_quat(smoothing.remove_jitter(measured, np.ones(len(measured), bool), RATE, 0.01))
    error = np.linalg.norm((smooth * Rotation.from_rotvec(angle[:, None] * [[0.0, 0.6, 0.8]]).inv()).as_rotvec(), axis=1)
    assert error.max() < 0.02
    assert np.sqrt((error[:90] ** 2).mean()) < 0.6 * 0.004 * np.sqrt(3)


def test_strike_of_a_joint_that_shares_its_twist_is_tracked():
    """Every frame shows the joint with the deviation of an arm whose shoulder and elbow share their twist."""
    angle, measured = draw_strikes(np.random.default_rng(5), 0.004)
    rotations = np.tile(np.eye(3), (300, 2, 1, 1))
    rotations[:, 1] = Rotation.from_quat(measured).as_matrix()
    uncertainty = PoseUncertainty(np.zeros((300, 0)), np.zeros((300, 2)), np.full((300, 2), 0.16**2), np.full(300, 1e-6))
    tracking = smoothing.smooth_poses(
        np.zeros((300, 3)), rotations, uncertainty, np.zeros((300, 2), bool), np.array([True, True]), RATE
    )
    truth = Rotation.from_rotvec(angle[:, None] * [[0.0, 0.6, 0.8]])
    deviation = (Rotation.from_matrix(tracking.rotations[:, 1]) * truth.inv()).magnitude()
    assert deviation.max() < 0.75 * 1.5  # it was 1.2 rad and more: the strike was missing
    assert deviation.mean() < 0.1

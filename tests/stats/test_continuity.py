import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.label_evidence import compute_leap, compute_own_leaps, compute_velocity
from mocapfix.stats import marker_distances

RATE = 100.0


def falling(frames=60):
    """Return (T, 2, 3) two markers, 0.2 m apart, with the same constant acceleration."""
    t = np.arange(frames)[:, None] / RATE
    path = np.array([1.0, 2.0, 0.5]) * t - np.array([0, 4.9, 0]) * t**2
    return np.stack([path, path + [0.2, 0, 0]], axis=1)


def test_velocities_span_two_steps():
    markers, t = falling(), 30 / RATE
    np.testing.assert_allclose(compute_velocity(markers, RATE, 30, 0, -1), [1.0, 2.0 - 9.8 * (t - 0.01), 0.5], rtol=1e-9)
    np.testing.assert_allclose(compute_velocity(markers, RATE, 30, 0, 1), [1.0, 2.0 - 9.8 * (t + 0.01), 0.5], rtol=1e-9)
    assert np.isnan(compute_velocity(markers, RATE, 0, 0, -1)).all()
    assert np.isnan(compute_velocity(markers, RATE, len(markers) - 1, 0, 1)).all()


def test_velocities_next_to_gaps():
    markers = falling()
    markers[20:30, 0] = np.nan
    np.testing.assert_allclose(compute_velocity(markers, RATE, 31, 0, -1), (markers[31, 0] - markers[30, 0]) * RATE)
    assert np.isnan(compute_velocity(markers, RATE, 30, 0, -1)).all()
    assert np.isnan(compute_velocity(markers, RATE, 19, 0, 1)).all()
    assert np.isfinite(compute_velocity(markers, RATE, 19, 0, -1)).all()


def test_previous_frame_across_gaps():
    markers = falling(10)
    markers[:2, 0] = markers[5:8, 0] = np.nan
    last = marker_distances.build_trajectories(markers, RATE).previous_frame
    assert last[:, 0].tolist() == [-1, -1, -1, 2, 3, 4, 4, 4, 4, 8]
    assert last[:, 1].tolist() == [-1, *range(9)]


@given(first=st.integers(4, 40), length=st.integers(0, 15))
def test_constant_acceleration_is_no_leap(first, length):
    markers = falling()
    markers[first : first + length, 0] = np.nan
    assert compute_own_leaps(marker_distances.build_trajectories(markers, RATE)).max() < 0.01


def test_leap_grows_with_the_distance_up_to_one():
    for off, least, most in ((0.005, 0.01, 0.15), (0.018, 0.5, 1.0), (0.3, 1.0, 1.0)):
        markers = falling()
        markers[30:, 0] += [0, 0, off]
        leaps = compute_own_leaps(marker_distances.build_trajectories(markers, RATE))[:, 0]
        assert least <= leaps[30] <= most
        assert leaps[np.r_[:29, 32:60]].max() < 0.01


def test_leap_to_another_trajectory_continues_that_one():
    markers = falling()
    markers[30:] = markers[30:, ::-1].copy()
    trajectories = marker_distances.build_trajectories(markers, RATE)
    assert compute_leap(trajectories, 30, 0, 0) == compute_leap(trajectories, 30, 1, 1) == 1.0
    assert compute_leap(trajectories, 30, 0, 1) < 0.01
    assert compute_leap(trajectories, 30, 1, 0) < 0.01


def test_leap_is_zero_without_samples_to_compare():
    markers = falling()
    markers[10:50, 0] = np.nan  # 0.4 s: forgotten
    markers[50:, 0] += 1.0
    trajectories = marker_distances.build_trajectories(markers, RATE)
    assert compute_leap(trajectories, 50, 0, 0) == 0.0
    assert compute_leap(trajectories, 0, 1, 1) == 0.0  # the take begins
    assert compute_leap(trajectories, 20, 1, 0) == 0.0  # not seen


def test_isolated_sample_has_a_larger_tolerance():
    markers = falling()
    markers[30:34, 0] = np.nan
    markers[35:, 0] = np.nan
    markers[34, 0] += [0.04, 0, 0]
    known = falling()
    known[30:34, 0] = np.nan
    known[34:, 0] += [0.04, 0, 0]
    alone, among = (compute_leap(marker_distances.build_trajectories(each, RATE), 34, 0, 0) for each in (markers, known))
    assert alone < among


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_trajectories_of_the_shortest_takes(frames):
    trajectories = marker_distances.build_trajectories(np.zeros((frames, 3, 3)), RATE)
    assert trajectories.previous_frame.shape == (frames, 3)
    assert compute_own_leaps(trajectories).shape == (frames, 3)

import numpy as np
import pytest

from mocapfix.labels.fragments import TrajectorySegment, compute_join_cost, is_smoother, measure_join_error

RATE = 120.0
FRAMES = np.arange(240)
PATH = np.stack([1.5 * FRAMES / RATE, np.sin(FRAMES / RATE * 4), 0 * FRAMES], axis=-1)


def build_segment(first, last, off=0.0):
    return TrajectorySegment(0, -1, FRAMES[first : last + 1], PATH[first : last + 1] + [0.0, 0.0, off])


def without(first, last):
    path = PATH.copy()
    path[first : last + 1] = np.nan
    return path


def test_join_error_of_a_parabola_is_zero():
    t = FRAMES / RATE
    fall = np.stack([2 * t, 3 * t - 4.905 * t**2, 0 * t], axis=-1)
    missed, seconds = measure_join_error(FRAMES[:50], fall[:50], FRAMES[56:], fall[56:], RATE)
    assert seconds == pytest.approx(7 / RATE)
    assert missed == pytest.approx(0, abs=1e-3 + 9.81 * 0.0125 * 2 * seconds)  # its velocities are means over 30 ms


def test_join_cost_of_true_and_shifted_paths():
    path = without(95, 165)
    assert compute_join_cost(build_segment(100, 160), path, RATE, 0.3) < 1
    assert compute_join_cost(build_segment(100, 160, off=0.05), path, RATE, 0.3) > 9
    assert compute_join_cost(build_segment(100, 160, off=5.0), path, RATE, 0.3) == pytest.approx(
        3.5**2
    )  # an end has no more say than that


def test_join_cost_is_nan_far_from_both_ends():
    assert np.isnan(compute_join_cost(build_segment(100, 160), without(50, 210), RATE, 0.3))
    assert compute_join_cost(build_segment(100, 160), without(50, 210), RATE, 0.5) < 1
    assert np.isnan(compute_join_cost(build_segment(100, 160), without(0, 239), RATE, 0.3))


def test_join_cost_of_simultaneous_paths():
    path = without(110, 239)
    assert compute_join_cost(build_segment(100, 160, off=0.005), path, RATE, 0.3) == pytest.approx(1.0)
    assert compute_join_cost(build_segment(100, 160, off=0.02), path, RATE, 0.3) == np.inf


def test_smoother_of_two_paths():
    shifted = PATH.copy()
    shifted[100:161] += [0.0, 0.0, 0.005]
    assert is_smoother(build_segment(100, 160), shifted, RATE)
    assert not is_smoother(build_segment(100, 160, off=0.005), PATH, RATE)
    assert not is_smoother(build_segment(100, 160), PATH, RATE)

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.edge_interpolation import RESTING_SPEED_M_S, build_edge_maps, compare_edge_motion, estimate_from_edges
from mocapfix.fill.fill_methods import MovingAxes
from mocapfix.fill.gap_estimates import choose_hidden_stretches

RATE = 100.0


def build_window(visible, first, last):
    return choose_hidden_stretches(visible, first, last, RATE)


@given(length=st.integers(1, 60), before=st.integers(0, 6), after=st.integers(0, 6))
def test_maps_keep_a_marker_at_rest(length, before, after):
    if before + after == 0:
        return
    maps = build_edge_maps(np.arange(-before, 0), length + np.arange(after), length, np.arange(length), RATE)
    assert len(maps) == 2 + (min(before, after) >= 3)
    for each in maps:
        np.testing.assert_allclose(each.sum(1), 1, atol=1e-9)


def test_straight_and_cubic_maps_are_exact():
    t = np.arange(-6, 26) / RATE
    line, parabola = 3 * t, 2 * t**2 - t
    context = np.r_[0:6, 26:32]
    straight, _, cubic = build_edge_maps(np.arange(-6, 0), 20 + np.arange(6), 20, np.arange(20), RATE)
    np.testing.assert_allclose(straight @ line[context], line[6:26], atol=1e-12)
    np.testing.assert_allclose(cubic @ parabola[context], parabola[6:26], atol=1e-9)


def test_marker_on_a_rigid_body_is_exact_in_its_axes():
    t = np.arange(400) / RATE
    rotation = Rotation.from_rotvec(np.stack([np.sin(3 * t), 2 * t, 0 * t], 1)).as_matrix()
    axes = MovingAxes(rotation, np.stack([t, np.cos(t), 0 * t], 1))
    truth = rotation @ np.array([0.1, 0.2, 0.3]) + axes.origin
    path, visible = truth.copy(), np.ones(400, bool)
    path[150:220], visible[150:220] = np.nan, False
    window = build_window(visible, 150, 219)
    for estimate in estimate_from_edges(path, axes, window, RATE, 1.0):
        np.testing.assert_allclose(estimate.position, truth[150:220], atol=1e-9)
        np.testing.assert_allclose(estimate.error, 0, atol=1e-9)
    world = estimate_from_edges(path, None, window, RATE, 1.0)
    assert np.abs(world[0].position - truth[150:220]).max() > 0.05
    assert np.abs(world[0].error).max() > 0.05


@pytest.mark.parametrize("method", [0, 1, 2])
def test_hidden_errors_are_those_of_the_gap(method):
    """The gap is one of the stretches that could be hidden, so that its error is like theirs."""
    t = np.arange(3000) / RATE
    truth = np.stack([np.sin(4 * t), np.cos(2.3 * t), np.sin(3 * t + 1)], 1)
    visible = np.ones(3000, bool)
    visible[1500:1540] = False
    path = np.where(visible[:, None], truth, np.nan)
    estimate = estimate_from_edges(path, None, build_window(visible, 1500, 1539), RATE, 3.0)[method]
    actual = np.sqrt(((estimate.position - truth[1500:1540]) ** 2).mean())
    assert 0.3 < actual / np.sqrt((estimate.error**2).mean()) < 3


def test_stretches_at_rest_are_similar_to_a_gap_at_rest():
    t = np.arange(2000) / RATE
    path = np.stack([np.where(t < 10, 0.0, np.sin(4 * (t - 10))), 0 * t, 0 * t], 1)
    visible = np.ones(2000, bool)
    visible[400:450] = False
    window = build_window(visible, 400, 449)
    speed, similarity = compare_edge_motion(np.where(visible[:, None], path, np.nan), window, RATE)
    assert speed == pytest.approx(RESTING_SPEED_M_S)
    is_resting = window.starts + 60 < 1000
    assert (similarity[is_resting] == 1).all()
    assert (similarity[window.starts > 1000] < 1e-3).all()


def test_edges_tell_less_of_a_longer_gap():
    visible = np.ones(100, bool)
    visible[40:45] = False
    motion = compare_edge_motion(np.zeros((100, 3)), build_window(visible, 40, 44), RATE)
    speeds = [motion.estimate_speed_in_gap(2.0, seconds) for seconds in (0.01, 1.0, 20.0)]
    assert RESTING_SPEED_M_S < speeds[0] < speeds[1] < speeds[2] <= 2.0

"""The floor: its height and tilt, steps as levels, and feet in the air on none."""

import numpy as np
import pytest

from mocapfix.contacts.contacts import NO_FLOOR, TOE_HEIGHT_M, Floor, estimate_floor
from tests.contacts.walking_feet import make_path, tilt

RATE = 100.0


def stand(*heights_m: float, seconds: float = 1.0) -> np.ndarray:
    """Return the path of toes that stand at heights, one after another."""
    frames = round(seconds * RATE)
    return np.concatenate([np.tile([0.0, height + TOE_HEIGHT_M, 0.0], (frames, 1)) for height in heights_m])


def estimate(left: np.ndarray, right: np.ndarray) -> Floor:
    """Return the floor of feet that stand all the time."""
    toes = np.stack([left, right], axis=1)
    return estimate_floor(toes, np.ones(toes.shape[:2], bool), RATE)


@pytest.mark.parametrize("height_m", [-0.4, 0.0, 0.7])
def test_height_of_a_level_floor(height_m):
    floor = estimate(stand(height_m), stand(height_m))
    assert floor.level_heights_m == pytest.approx((height_m,), abs=1e-6)
    assert floor.height_m == pytest.approx(height_m, abs=1e-6)
    assert floor.tilt_deg == 0.0


def test_steps_are_levels():
    heights = (0.0, 0.17, 0.34)
    assert estimate(stand(*heights), stand(*heights)).level_heights_m == pytest.approx(heights, abs=1e-6)


def test_the_foot_that_stands_higher_while_the_other_stands_low_is_on_no_level():
    assert estimate(stand(0.0), stand(0.3)).level_heights_m == pytest.approx((0.0,), abs=1e-6)


def test_a_foot_stands_on_a_step_while_the_other_swings_below_it():
    toes = np.stack([np.vstack([stand(0.2), stand(0.0)]), np.vstack([stand(0.0), stand(0.0)])], axis=1)
    is_standing = np.ones(toes.shape[:2], bool)
    is_standing[:100, 1] = False
    assert estimate_floor(toes, is_standing, RATE).level_heights_m == pytest.approx((0.0, 0.2), abs=1e-6)


def test_low_places_within_half_a_step_are_one_level():
    assert len(estimate(stand(0.0, 0.04), stand(0.0, 0.04)).level_heights_m) == 1


def test_tilt_of_a_floor_that_is_walked_in_both_directions():
    corners = [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0), (3, 3), (0, 3), (3, 0)]
    stances = [(2.0 * k, 2.0 * k + 1.5, (float(x), TOE_HEIGHT_M, float(z))) for k, (x, z) in enumerate(corners)]
    path = tilt(make_path(stances, 16.0, RATE), 2.0)
    time_s = np.arange(len(path)) / RATE
    is_standing = np.repeat(((time_s % 2.0) < 1.5)[:, None], 2, axis=1)
    floor = estimate_floor(np.stack([path, path], axis=1), is_standing, RATE)
    assert floor.tilt_deg == pytest.approx(2.0, abs=0.05)
    assert floor.slope_x == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(floor.compute_height_above(path[is_standing[:, 0]]), TOE_HEIGHT_M, atol=2e-3)


def test_steps_in_both_directions_are_no_tilt():
    places = [(0, 0, 0), (2, 0.2, 0), (2, 0.4, 2), (0, 0.2, 2), (0, 0, 0), (2, 0.2, 0), (2, 0.0, 2), (0, 0.4, 2)]
    stances = [(2.0 * k, 2.0 * k + 1.5, (float(x), TOE_HEIGHT_M + y, float(z))) for k, (x, y, z) in enumerate(places)]
    path = make_path(stances, 16.0, RATE)
    is_standing = np.repeat(((np.arange(len(path)) / RATE % 2.0) < 1.5)[:, None], 2, axis=1)
    floor = estimate_floor(np.stack([path, path], axis=1), is_standing, RATE)
    assert floor.tilt_deg == 0.0
    assert floor.level_heights_m == pytest.approx((0.0, 0.2, 0.4), abs=1e-3)


def test_without_a_stance_there_is_no_floor():
    assert estimate_floor(np.zeros((10, 2, 3)), np.zeros((10, 2), bool), RATE) is NO_FLOOR
    assert NO_FLOOR.height_m == 0.0


def test_heights_are_above_the_level_below():
    floor = Floor(0.0, 0.0, (0.0, 0.2))
    position = np.array([[0.0, y, 0.0] for y in (-0.1, 0.05, 0.13, 0.15, 0.3)])
    np.testing.assert_allclose(floor.compute_height_above(position), [-0.1, 0.05, 0.13, -0.05, 0.1])

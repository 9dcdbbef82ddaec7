"""Functional joints between rigid groups."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.subject.unlabelled_markers import build_moving_group, estimate_functional_joint

FRAMES, NOISE_M = 120, 0.0005
JOINT = np.array([0.1, -0.4, 0.05])
"""In the axes of the first group."""


def move_groups(seed: int, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Return the markers of two groups that turn about a joint by rotation vectors (T, 3), the joint, and the first rotation."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 5, FRAMES)
    shapes = 0.08 * np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) + rng.normal(0, 0.02, (2, 4, 3))
    first = Rotation.from_rotvec(np.outer(np.sin(time), rng.normal(0, 0.5, 3)))
    second = first * Rotation.from_rotvec(angles)
    origin = np.outer(time, [0.3, 0, 0.1])
    joint = origin + first.apply(JOINT)
    one = np.stack([origin + first.apply(place) for place in shapes[0]], axis=1)
    other = np.stack([joint + second.apply(place + [0, -0.2, 0]) for place in shapes[1]], axis=1)
    markers = np.concatenate([one, other], axis=1)
    return markers + rng.normal(0, NOISE_M, markers.shape), joint, first


@given(seed=st.integers(0, 1000))
def test_a_ball_joint_is_where_the_groups_turn_about_it(seed):
    time = np.linspace(0, 9, FRAMES)
    angles = 0.5 * np.stack([np.sin(time), np.sin(1.4 * time), np.cos(0.8 * time)], axis=1)
    markers, joint, _ = move_groups(seed, angles)
    first, second = build_moving_group(markers, (0, 1, 2, 3)), build_moving_group(markers, (4, 5, 6, 7))
    found = estimate_functional_joint(first, second)
    assert found is not None
    assert found.residual_m < 0.005
    for group, place in zip((first, second), found.places, strict=True):
        assert np.linalg.norm(group.move(place) - joint, axis=1).mean() < 0.005


def test_a_hinge_is_found_across_its_axis():
    angles = np.outer(0.6 + 0.5 * np.sin(np.linspace(0, 9, FRAMES)), [1.0, 0, 0])
    markers, joint, rotation = move_groups(3, angles)
    first, second = build_moving_group(markers, (0, 1, 2, 3)), build_moving_group(markers, (4, 5, 6, 7))
    found = estimate_functional_joint(first, second)
    assert found is not None
    error = rotation.inv().apply(first.move(found.places[0]) - joint).mean(0)
    assert np.linalg.norm(error[1:]) < 0.005
    assert abs(error[0]) < 0.1  # along the axis the joint is between the groups
    assert found.residual_m < 0.005
    assert found.range_rad == pytest.approx(0.5 / np.sqrt(2), rel=0.2)


def test_groups_that_are_hardly_visible_together_have_no_joint():
    markers, _, _ = move_groups(1, np.zeros((FRAMES, 3)))
    markers[: FRAMES - 10, :4], markers[FRAMES - 10 :, 4:] = np.nan, np.nan
    first, second = build_moving_group(markers, (0, 1, 2, 3)), build_moving_group(markers, (4, 5, 6, 7))
    assert estimate_functional_joint(first, second) is None

"""One outlier among a segment's markers does not change its pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels import belief_propagation
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)
WORKSPACE = belief_propagation.RegistrationWorkspace(
    np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3))
)


def fit(seen, places, weight, inlier_weight):
    """Return the pose, its row of moments, and the inlier_weight in each marker"""
    row, pose, inlier_weight = (
        np.zeros(belief_propagation.STATISTICS_SIZE),
        np.empty(belief_propagation.SEGMENT_POSE_SIZE),
        np.array(inlier_weight, float),
    )
    for w, x, p in zip(weight * inlier_weight, seen, places, strict=True):
        belief_propagation.add_point(row, w, x, p)
    spare = np.empty(belief_propagation.STATISTICS_SIZE), np.empty(belief_propagation.SEGMENT_POSE_SIZE)
    belief_propagation.fit_segment_pose_robustly(seen, places, weight, inlier_weight, row, pose, WORKSPACE, spare)
    return pose, row, inlier_weight


def cloud(rng, count):
    """Return places (K, 3) about a hand's width apart, and where a motion carries them (K, 3)"""
    places = 0.1 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [0, 0, 2.0]])[:count]
    return places, places @ random_terms.draw_rotations(rng, 1)[0].T + rng.normal(0, 2, 3)


@given(seeds, st.sampled_from([4, 5]), st.floats(0.15, 5))
def test_one_outlier_hardly_moves_the_segment(seed, count, off):
    rng = np.random.default_rng(seed)
    places, points = cloud(rng, count)
    wrong, seen = rng.integers(count), points + rng.normal(0, 0.001, points.shape)
    seen[wrong] += off * random_terms.draw_units(rng, 1)[0]
    pose, _, inlier_weight = fit(seen, places, np.full(count, 1e4), np.ones(count))
    np.testing.assert_allclose([belief_propagation.transform_point(pose, p) for p in places], points, atol=0.02)
    assert inlier_weight[wrong] < 0.05
    assert np.delete(inlier_weight, wrong).min() > 0.9


@given(seeds)
def test_consistent_markers_keep_full_weight(seed):
    rng = np.random.default_rng(seed)
    places, points = cloud(rng, 5)
    pose, _, inlier_weight = fit(points + rng.normal(0, 0.005, points.shape), places, np.full(5, 1e4), np.ones(5))
    np.testing.assert_array_equal(inlier_weight, 1.0)
    np.testing.assert_allclose([belief_propagation.transform_point(pose, p) for p in places], points, atol=0.03)


@pytest.mark.parametrize("off", [0.0, 0.3])
def test_statistics_hold_the_inlier_weights_and_no_missing_marker(off):
    rng = np.random.default_rng(1)
    places, seen = cloud(rng, 5)
    seen[3] += [0.0, off, 0.0]
    seen[1] = np.nan
    weight, held = rng.uniform(1e3, 1e4, 5), np.zeros(belief_propagation.STATISTICS_SIZE)
    row, pose, inlier_weight = (
        np.zeros(belief_propagation.STATISTICS_SIZE),
        np.empty(belief_propagation.SEGMENT_POSE_SIZE),
        np.array([1.0, 0, 1, 1, 1]),
    )
    for n in (0, 2, 3, 4):
        belief_propagation.add_point(row, weight[n], seen[n], places[n])
    belief_propagation.fit_segment_pose_robustly(
        seen,
        places,
        weight,
        inlier_weight,
        row,
        pose,
        WORKSPACE,
        (np.empty(belief_propagation.STATISTICS_SIZE), np.empty(belief_propagation.SEGMENT_POSE_SIZE)),
    )
    for n in (0, 2, 3, 4):
        belief_propagation.add_point(held, inlier_weight[n] * weight[n], seen[n], places[n])
    np.testing.assert_allclose(row, held, atol=1e-8)
    assert inlier_weight[1] == 0
    assert (inlier_weight[3] < 0.5) == (off > 0)

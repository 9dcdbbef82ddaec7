"""Rotations between point clouds, shortest rotations, and generalised Procrustes alignment."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.stats.rigid_alignment import (
    align_to_shape,
    compute_cross_covariance,
    compute_rotation_vectors,
    compute_rotations,
    compute_shortest_rotation,
    find_nearest_points,
    fit_common_shape,
    fit_rotations,
    scale_rotations,
    transform_to_body_axes,
)
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_moved_cloud_recovers_its_rotation(seed):
    rng = np.random.default_rng(seed)
    model, rotation, translation = rng.normal(size=(5, 3)), random_terms.draw_rotations(rng, 4), rng.normal(size=(4, 1, 3))
    weight = rng.uniform(0.5, 2, (4, 5))
    cross, mean_points, mean_model = compute_cross_covariance(
        np.einsum("tab,kb->tka", rotation, model) + translation, model, weight
    )
    np.testing.assert_allclose(fit_rotations(cross), rotation, atol=1e-7)
    np.testing.assert_allclose(np.einsum("tab,tb->ta", rotation, mean_model) + translation[:, 0], mean_points, atol=1e-9)


@given(seeds)
def test_points_without_weight_are_ignored(seed):
    rng = np.random.default_rng(seed)
    points, model, weight = rng.normal(size=(3, 6, 3)), rng.normal(size=(6, 3)), np.ones((3, 6))
    weight[:, 4:] = 0
    damaged = points.copy()
    damaged[:, 4:] = np.nan
    for one, other in zip(
        compute_cross_covariance(damaged, model, weight),
        compute_cross_covariance(points[:, :4], model[:4], weight[:, :4]),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_zero_cross_covariance_gives_the_identity():
    np.testing.assert_array_equal(fit_rotations(np.zeros((2, 3, 3))), np.tile(np.eye(3), (2, 1, 1)))
    assert all(
        (each == 0).all() for each in compute_cross_covariance(np.full((1, 4, 3), np.nan), np.ones((4, 3)), np.zeros((1, 4)))
    )


@given(seeds, st.floats(-12, 12))
def test_rotation_does_not_depend_on_the_clouds_size(seed, size):
    rng = np.random.default_rng(seed)
    rotation = random_terms.draw_rotations(rng, 3)
    np.testing.assert_allclose(fit_rotations(rotation * 10.0**size), rotation, atol=1e-9)


@given(seeds, st.sampled_from([0, 1, 2, 3]))
def test_fitted_rotation_is_never_a_reflection(seed, rank):
    rng = np.random.default_rng(seed)
    model, measured = rng.normal(size=(2, 5, 6, 3))
    model[..., rank:] = measured[..., rank:] = 0.0  # at one point, collinear, coplanar, in space
    found = fit_rotations(np.einsum("tka,tkb->tab", measured, model))
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)


@given(seeds)
def test_mirrored_cloud_gets_the_best_rotation(seed):
    rng = np.random.default_rng(seed)
    model = rng.normal(size=(6, 3))
    cross = (model * [-1, 1, 1]).T @ model
    best = np.trace(fit_rotations(cross[None])[0].T @ cross)
    assert best >= max(np.trace(each.T @ cross) for each in random_terms.draw_rotations(rng, 200)) - 1e-9


@given(seeds)
def test_body_axes_round_trip(seed):
    rng = np.random.default_rng(seed)
    points, centre, rotation = rng.normal(size=(3, 4, 3)), rng.normal(size=(3, 3)), random_terms.draw_rotations(rng, 3)
    points[1, 2] = np.nan
    own = transform_to_body_axes(points, centre, rotation)
    np.testing.assert_allclose(np.einsum("tab,tkb->tka", rotation, own) + centre[:, None], points, atol=1e-12)


def test_trunk_dominates_the_alignment():
    rng = np.random.default_rng(0)
    t = np.arange(200) / 50
    model = rng.normal(scale=0.3, size=(10, 3))
    own = np.tile(model, (200, 1, 1))
    own[:, 6:] += 0.3 * np.sin(4 * t[:, None, None] + rng.uniform(0, 6, (4, 3)))
    rotation = Rotation.from_rotvec(np.stack([0.2 * np.sin(t), 0.9 * t, 0 * t], 1)).as_matrix()
    markers = np.einsum("tab,tmb->tma", rotation, own) + np.stack([t, 1 + 0 * t, np.cos(t)], 1)[:, None]
    markers[50:90, 2] = markers[120:, 8] = np.nan
    axes, origin, placed = align_to_shape(markers, ~np.isnan(markers[..., 0]), fit_common_shape(markers))
    assert placed.all()
    trunk = transform_to_body_axes(markers, origin, axes)[:, :6]
    assert np.nanstd(trunk, axis=0).max() < 0.003


def test_fewer_than_three_markers_are_not_aligned():
    markers = np.random.default_rng(1).normal(size=(5, 6, 3))
    markers[3, 2:] = np.nan
    _, _, placed = align_to_shape(markers, ~np.isnan(markers[..., 0]), fit_common_shape(markers))
    np.testing.assert_array_equal(placed, [True, True, True, False, True])


VECTORS = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


@given(VECTORS, VECTORS)
def test_shortest_rotation_maps_one_direction_to_the_other(a, b):
    assume(np.linalg.norm(a) > 1e-6 and np.linalg.norm(b) > 1e-6)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    assume(a @ b > -1 + 1e-9)  # opposite directions are tested below
    rotation = compute_shortest_rotation(3 * a, b)
    np.testing.assert_allclose(rotation @ a, b, atol=1e-8)
    np.testing.assert_allclose((np.trace(rotation) - 1) / 2, a @ b, atol=1e-8)


def test_opposite_directions_give_a_half_turn():
    for a in np.eye(3):
        rotation = compute_shortest_rotation(a, -a)
        np.testing.assert_allclose(rotation @ a, -a, atol=1e-12)
        np.testing.assert_allclose((np.linalg.det(rotation), np.trace(rotation)), (1, -1), atol=1e-12)


def test_zero_vectors_give_the_identity():
    np.testing.assert_array_equal(compute_shortest_rotation(np.zeros(3), np.ones(3)), np.eye(3))
    np.testing.assert_array_equal(compute_shortest_rotation(np.ones(3), np.zeros(3)), np.eye(3))


@given(seeds)
def test_nearest_point_is_nearer_than_any_other_of_the_line(seed):
    rng = np.random.default_rng(seed)
    point, start, end = rng.normal(size=(3, 1, 3))
    share, vector = find_nearest_points(point, start, end)
    assert 0 <= share[0] <= 1
    shares = np.linspace(0, 1, 101)[:, None]
    assert np.linalg.norm(vector) <= np.linalg.norm(point - start - shares * (end - start), axis=1).min() + 1e-12


def test_rotation_vectors_are_those_of_scipy():
    vectors = np.random.default_rng(0).normal(size=(50, 2, 3))
    vectors[0], vectors[1] = 1e-9, [[0.0, np.pi - 1e-9, 0.0]] * 2
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(50, 2, 3, 3)
    np.testing.assert_allclose(compute_rotations(vectors), rotations, atol=1e-14)
    expected = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(50, 2, 3)
    np.testing.assert_allclose(compute_rotation_vectors(rotations), expected, atol=1e-9)
    np.testing.assert_allclose(scale_rotations(rotations, 0.5), compute_rotations(expected / 2), atol=1e-9)
    assert np.isnan(scale_rotations(np.full((1, 3, 3), np.nan), 0.5)).all()

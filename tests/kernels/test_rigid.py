"""The best rotation between two clouds: exact where there is one, a rotation in any case."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.rigid_registration import compute_cross_covariance, fit_rotations, transform_to_body_axes
from tests.kernels import drawn

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_a_moved_cloud_gives_its_motion_back(seed):
    rng = np.random.default_rng(seed)
    places, turn, way = rng.normal(size=(5, 3)), drawn.rotations(rng, 4), rng.normal(size=(4, 1, 3))
    weight = rng.uniform(0.5, 2, (4, 5))
    cross, here, there = compute_cross_covariance(np.einsum("tab,kb->tka", turn, places) + way, places, weight)
    np.testing.assert_allclose(fit_rotations(cross), turn, atol=1e-7)
    np.testing.assert_allclose(np.einsum("tab,tb->ta", turn, there) + way[:, 0], here, atol=1e-9)


@given(seeds)
def test_points_without_weight_do_not_count_even_where_they_are_not_known(seed):
    rng = np.random.default_rng(seed)
    seen, places, weight = rng.normal(size=(3, 6, 3)), rng.normal(size=(6, 3)), np.ones((3, 6))
    weight[:, 4:] = 0
    damaged = seen.copy()
    damaged[:, 4:] = np.nan
    for one, other in zip(
        compute_cross_covariance(damaged, places, weight),
        compute_cross_covariance(seen[:, :4], places[:4], weight[:, :4]),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_nothing_turns_nothing():
    np.testing.assert_array_equal(fit_rotations(np.zeros((2, 3, 3))), np.tile(np.eye(3), (2, 1, 1)))
    assert all(
        (each == 0).all() for each in compute_cross_covariance(np.full((1, 4, 3), np.nan), np.ones((4, 3)), np.zeros((1, 4)))
    )


@given(seeds, st.floats(-12, 12))
def test_the_size_of_the_cloud_does_not_matter(seed, size):
    rng = np.random.default_rng(seed)
    turn = drawn.rotations(rng, 3)
    np.testing.assert_allclose(fit_rotations(turn * 10.0**size), turn, atol=1e-9)


@given(seeds, st.sampled_from([0, 1, 2, 3]))
def test_what_is_fitted_is_never_a_reflection(seed, rank):
    rng = np.random.default_rng(seed)
    model, measured = rng.normal(size=(2, 5, 6, 3))
    model[..., rank:] = measured[..., rank:] = 0.0  # at one point, collinear, coplanar, in space
    found = fit_rotations(np.einsum("tka,tkb->tab", measured, model))
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)


@given(seeds)
def test_a_mirrored_cloud_gets_the_best_rotation_there_is(seed):
    rng = np.random.default_rng(seed)
    model = rng.normal(size=(6, 3))
    cross = (model * [-1, 1, 1]).T @ model
    best = np.trace(fit_rotations(cross[None])[0].T @ cross)
    assert best >= max(np.trace(each.T @ cross) for each in drawn.rotations(rng, 200)) - 1e-9


@given(seeds)
def test_what_is_carried_inside_comes_back_out(seed):
    rng = np.random.default_rng(seed)
    points, centre, turn = rng.normal(size=(3, 4, 3)), rng.normal(size=(3, 3)), drawn.rotations(rng, 3)
    points[1, 2] = np.nan
    own = transform_to_body_axes(points, centre, turn)
    np.testing.assert_allclose(np.einsum("tab,tkb->tka", turn, own) + centre[:, None], points, atol=1e-12)

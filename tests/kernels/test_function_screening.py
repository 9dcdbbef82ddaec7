import numpy as np
import pytest

from mocapfix.kernels.function_screening import measure_pair_sds, screen_mean, screen_pairs, screen_places
from mocapfix.stats.point_function_search import compute_known_median
from mocapfix.stats.point_functions import MIN_FRAME_SINE, build_frame_axes

LIMIT_M = 1e-5


def draw_points(seed: int, frames: int, count: int, missing: float = 0.2) -> np.ndarray:
    random = np.random.default_rng(seed)
    points = random.normal(size=(frames, count, 3))
    points[random.random((frames, count)) < missing] = np.nan
    return points


@pytest.mark.parametrize("frames", [1, 2, 5, 20, 61])
def test_spread_of_distances_is_the_median_deviation(frames):
    points = draw_points(frames, frames, 7, 0.3)
    one, other = np.triu_indices(7, 1)
    found = measure_pair_sds(np.ascontiguousarray(points.transpose(2, 1, 0)), one, other, 3)
    distance = np.linalg.norm(points[:, one] - points[:, other], axis=-1)
    expected = 1.5 * compute_known_median(np.abs(distance - compute_known_median(distance)))
    expected[(~np.isnan(distance)).sum(0) < 3] = np.inf
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("frames", [5, 20])
@pytest.mark.parametrize("max_misfit_m", [0.3, 1.0])
def test_points_between_two_are_those_near_their_line_at_one_ratio(frames, max_misfit_m):
    points = draw_points(frames, frames, 15, 0.1)
    others = points[:, 1:]
    own = 0.4 * others[:, 3] + 0.6 * others[:, 8] + 0.05 * points[:, 0]
    found = screen_pairs(own, np.ascontiguousarray(others.swapaxes(0, 1)), max_misfit_m, 1e-3)
    one, other = np.triu_indices(14, 1)
    step, relative = others[:, other] - others[:, one], own[:, None] - others[:, one]
    ratio = compute_known_median((relative * step).sum(-1) / (step * step).sum(-1))
    misfit = compute_known_median(np.linalg.norm(relative - np.where(np.isfinite(ratio), ratio, 0)[:, None] * step, axis=-1))
    is_between = (ratio > 1e-3) & (ratio < 1 - 1e-3) & (misfit < max_misfit_m)
    expected = np.full((14, 14), np.inf)
    expected[one, other] = np.where(is_between, misfit, np.inf)
    assert is_between.any()
    assert not is_between.all()
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def fit_by_reweighting(target: np.ndarray, basis: np.ndarray, rounds: int) -> float:
    known = np.isfinite(target).all(-1) & np.isfinite(basis).all((-1, -2))
    target, basis, weight = target[known], basis[known], np.ones(known.sum())
    misfit = np.zeros(0)
    for _ in range(rounds):
        normal = np.einsum("t,txu,txv->uv", weight, basis, basis) + LIMIT_M**2 * np.eye(basis.shape[-1])
        solution = np.linalg.solve(normal, np.einsum("t,txu,tx->u", weight, basis, target))
        misfit = np.linalg.norm(target - basis @ solution, axis=-1)
        weight = LIMIT_M / np.maximum(misfit, LIMIT_M)
    return float(compute_known_median(misfit))


@pytest.mark.parametrize("rounds", [2, 6])
def test_misfit_of_a_mean_and_of_a_place_are_those_of_a_regression(rounds):
    points = draw_points(3, 20, 6, 0.03)
    own, near = np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1:])
    basis = (near[:, 1:] - near[:, :1]).swapaxes(-1, -2)
    expected = fit_by_reweighting(own - near[:, 0], basis, rounds)
    assert screen_mean(own, near, LIMIT_M, rounds) == pytest.approx(expected, rel=1e-6)
    weights = np.zeros((2, 3, 5))
    weights[0, [0, 1, 2], [0, 1, 2]] = 1
    weights[1, [0, 1, 2, 2], [4, 1, 2, 3]] = 1, 1, 0.5, 0.5
    found = screen_places(own, near, weights, False, MIN_FRAME_SINE, LIMIT_M, rounds)
    spanning = screen_places(own, near, weights, True, MIN_FRAME_SINE, LIMIT_M, rounds)
    for n in range(2):
        used = np.flatnonzero(weights[n].any(0))
        corners = np.einsum("cp,tpx->tcx", weights[n][:, used], near[:, used])
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        axes, others = build_frame_axes(corners), build_frame_axes(corners[:, [0, 2, 1]])
        basis = np.concatenate([np.stack([first, second], -1), axes.swapaxes(-1, -2)], -1)
        assert found[n] == pytest.approx(fit_by_reweighting(own - corners[:, 0], basis, rounds), rel=1e-4)
        basis = np.stack([first, second, axes[:, 0], others[:, 0], axes[:, 2]], -1)
        assert spanning[n] == pytest.approx(fit_by_reweighting(own - corners[:, 0], basis, rounds), rel=1e-4)

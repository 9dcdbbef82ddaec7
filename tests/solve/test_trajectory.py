"""Trajectories: splines, the costs of control points, and solutions that are known."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.kernels.hinged_tree import HingedTerms, HingedTree, LinkRotationTerm, PlaceTerm, linearise_hinged_frames
from mocapfix.solve.trajectory import (
    ROOT_UNKNOWNS,
    BalanceTerm,
    CollisionTerm,
    ControlCosts,
    FloorTerm,
    LineTerm,
    Trajectory,
    build_spline_basis,
    compute_hinged_costs,
    minimise_trajectory,
)

RATE, FRAMES, REACH = 60.0, 90, 0.5
FREE = ControlCosts(np.array([[-np.inf, np.inf]]), np.array([np.inf]), 0.01, np.zeros(1), 100.0, np.full(7, 1e3), np.full(7, 1e5))
"""Costs that hardly pull."""


@pytest.fixture(scope="module")
def tree() -> HingedTree:
    """A root with an arm that turns about Z."""
    return HingedTree(
        np.array([-1, 0]),
        np.zeros((2, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        np.array([0, 0, 1]),
        np.array([[0.0, 0, 1]]),
        np.zeros((1, 3)),
        np.array([False]),
        np.array([0]),
        np.ones(1),
        np.zeros(1),
        np.array([[0], [0]]),
        np.array([0, 1]),
    )


def build_terms(angles: np.ndarray, path: np.ndarray) -> HingedTerms:
    """Return terms by which the root is on a path and not turned, and the end of the arm is at angles about Z."""
    count, pairs, none, links = len(angles), np.zeros((0, 2), int), np.zeros((0, 3)), np.zeros(0, int)
    ends = path + REACH * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    places = np.stack([path, ends], axis=1)
    turns = np.tile(np.eye(3), (count, 1, 1, 1))
    return HingedTerms(
        PlaceTerm(np.array([0, 1]), np.array([[0.0, 0, 0], [REACH, 0, 0]]), places, np.full(places.shape, 1e6)),
        FloorTerm(links, none, np.zeros(0), 1.0),
        LineTerm(pairs, np.zeros((0, 2, 3)), np.zeros((count, 0, 3)), np.zeros((count, 0))),
        LinkRotationTerm(np.array([0]), turns, np.full((count, 1), 1e4)),
        CollisionTerm(
            links, np.zeros((0, 2, 3)), np.zeros(0), pairs, links, none, np.zeros((0, 3, 3)), none, pairs, 0.0, 1.0
        ),
        BalanceTerm(links, none, np.zeros(0), np.zeros((count, 2)), np.zeros(count)),
    )  # fmt: skip


def start_trajectory(interval: int = 2) -> Trajectory:
    """Return the trajectory whose unknowns are all zero."""
    basis = build_spline_basis(FRAMES, RATE, interval)
    return Trajectory(basis, np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((basis.point_count, ROOT_UNKNOWNS + 1)))


def solve(tree, terms, costs, start=None) -> tuple[Trajectory, float]:
    return minimise_trajectory(tree, terms, costs, start or start_trajectory(), max_iterations=60, min_decrease=1e-9)


@pytest.mark.parametrize("interval", [1, 2, 4])
def test_splines_hold_cubic_polynomials(interval):
    basis = build_spline_basis(FRAMES, RATE, interval)
    np.testing.assert_allclose(basis.weights.sum(axis=1), 1.0)
    times = np.arange(FRAMES) / RATE
    values = np.stack([times**3 - times, 2 - times**2], axis=1)
    np.testing.assert_allclose(basis.evaluate(basis.fit(values)), values, atol=2e-3)


def test_fit_finds_the_control_points_again():
    basis = build_spline_basis(FRAMES, RATE, 3)
    points = np.random.default_rng(1).normal(size=(basis.point_count, 2))
    np.testing.assert_allclose(basis.fit(basis.evaluate(points))[2:-2], points[2:-2], atol=1e-3)


def test_parts_of_a_trajectory_have_its_frames():
    start = start_trajectory(3)
    whole = replace(start, points=np.random.default_rng(1).normal(size=start.points.shape))
    part = whole.select_points(4, 15)
    np.testing.assert_allclose(part.unknowns, whole.unknowns[12 : 12 + len(part.references)])
    assert len(whole.select_points(0, len(whole.points)).references) == FRAMES


def test_derivatives_of_control_costs_are_those_of_the_cost():
    """The cost is quadratic where no limit begins, so differences of the gradient are the curvature."""
    rng, basis = np.random.default_rng(2), build_spline_basis(20, 50.0, 2)
    size, count = ROOT_UNKNOWNS + 2, basis.point_count
    costs = ControlCosts(
        np.array([[-0.5, 0.4], [-np.inf, 0.1]]), np.array([3.0, np.inf]), 0.5, np.array([0.2, -0.1]), 2.0,
        rng.uniform(5, 20, size), rng.uniform(50, 200, size),
    )  # fmt: skip
    points = rng.normal(size=(count, size))

    def add(points):
        band, gradient = np.zeros((count * size, 4 * size)), np.zeros((count, size))
        return costs.add(basis, points, band, gradient), gradient.ravel(), band

    _, gradient, band = add(points)
    dense = np.zeros((count * size, count * size))
    for column in range(count * size):
        rows = np.arange(column, min(column + 4 * size, count * size))
        dense[rows, column] = dense[column, rows] = band[column, : len(rows)]
    for k in rng.choice(count * size, 40, replace=False):
        step = np.zeros(count * size)
        step[k] = 1e-6
        (low, low_gradient, _), (high, high_gradient, _) = (add(points + sign * step.reshape(count, size)) for sign in (-1, 1))
        assert (high - low) / 2e-6 == pytest.approx(gradient[k], rel=1e-4, abs=1e-3)
        np.testing.assert_allclose((high_gradient - low_gradient) / 2e-6, dense[k], atol=1e-4 * float(dense[k, k]))


def test_a_motion_that_a_spline_holds_is_found(tree):
    times = np.arange(FRAMES) / RATE
    angles, path = 1.0 + 0.8 * times - 0.5 * times**2, np.stack([times, 0.2 * times**2, 1 + 0 * times], axis=1)
    found, cost = solve(tree, build_terms(angles, path), FREE)
    np.testing.assert_allclose(found.unknowns[:, ROOT_UNKNOWNS], angles, atol=1e-3)
    np.testing.assert_allclose(found.unknowns[:, :3], path, atol=1e-4)
    frames = compute_hinged_costs(tree, build_terms(angles, path), found.references, found.unknowns)
    assert frames.sum() < cost < 10.0


def test_costs_of_frames_are_those_of_the_kernel(tree):
    terms, start = build_terms(np.linspace(0, 1, FRAMES), np.zeros((FRAMES, 3))), start_trajectory()
    curvature, gradient = np.empty((FRAMES, 7, 7)), np.empty((FRAMES, 7))
    total = linearise_hinged_frames(tree, terms, np.arange(FRAMES), start.references, start.unknowns, False, curvature, gradient)
    costs = compute_hinged_costs(tree, terms, start.references, start.unknowns)
    assert costs.sum() == pytest.approx(total)
    np.testing.assert_allclose(costs, 0.5e6 * REACH**2 * (2 - 2 * np.cos(np.linspace(0, 1, FRAMES))), rtol=1e-9, atol=1e-6)


def weaken_arm(terms: HingedTerms) -> HingedTerms:
    """Return the terms with a weak pull at the end of the arm, so that the root stays."""
    weights = terms.place.weights.copy()
    weights[:, 1] = 100.0
    turns = terms.rotation._replace(weights=np.full(terms.rotation.weights.shape, 1e6))
    return terms._replace(place=terms.place._replace(weights=weights), rotation=turns)


def test_limits_of_positions_hold(tree):
    """An arm is asked to turn by 2 rad, and may turn by 1 rad."""
    angles = np.linspace(0.0, 2.0, FRAMES)
    terms = weaken_arm(build_terms(angles, np.zeros((FRAMES, 3))))
    found = solve(tree, terms, replace(FREE, limits=np.array([[-1.0, 1.0]])))[0].unknowns[:, ROOT_UNKNOWNS]
    assert found.max() <= 1.0
    assert np.abs(found - np.minimum(angles, 1.0)).max() < 0.15


def test_limits_of_speeds_hold(tree):
    """An arm is asked to turn with 6 rad/s for a while, and may with 4."""
    angles = np.clip(6.0 * (np.arange(FRAMES) / RATE - 0.6), 0.0, 1.8)
    terms = weaken_arm(build_terms(angles, np.zeros((FRAMES, 3))))
    limited = replace(FREE, speed_limits=np.array([4.0]), speed_sd=0.05)
    free, _ = solve(tree, terms, FREE)
    bound, _ = solve(tree, terms, limited, free)
    speeds = [np.abs(np.diff(each.unknowns[:, ROOT_UNKNOWNS])).max() * RATE for each in (free, bound)]
    assert speeds[0] > 5.5
    assert speeds[1] < 4.2
    slow = bound.limit_speeds(np.array([4.0])).unknowns[:, ROOT_UNKNOWNS]
    assert np.abs(np.diff(slow)).max() * RATE <= 4.0 + 1e-9
    assert np.abs(slow - bound.unknowns[:, ROOT_UNKNOWNS]).max() < 0.02
    np.testing.assert_allclose(bound.limit_speeds(np.array([4.5])).points, bound.points, atol=1e-12)
    assert np.abs(bound.unknowns[:, ROOT_UNKNOWNS] - angles).max() < 0.4


def test_the_last_frames_decide_the_first_ones(tree):
    """Only the end has data: a stiff spline carries its speed back to the beginning."""
    times = np.arange(FRAMES) / RATE
    terms = build_terms(0.5 * times, np.zeros((FRAMES, 3)))
    weights = terms.place.weights.copy()
    weights[: FRAMES // 2, 1] = 0.0
    terms = terms._replace(place=terms.place._replace(weights=weights))
    found, _ = solve(tree, terms, replace(FREE, acceleration_sd=np.full(7, 1.0), jerk_sd=np.full(7, 10.0)))
    np.testing.assert_allclose(found.unknowns[:, ROOT_UNKNOWNS], 0.5 * times, atol=0.02)


def test_every_second_frame_gives_nearly_the_same_trajectory(tree):
    times = np.arange(FRAMES) / RATE
    terms = build_terms(np.sin(2 * times), np.zeros((FRAMES, 3)))
    whole, _ = solve(tree, terms, FREE)
    half, _ = minimise_trajectory(tree, terms, FREE, start_trajectory(), frame_step=2, max_iterations=60, min_decrease=1e-9)
    np.testing.assert_allclose(half.unknowns[:-1], whole.unknowns[:-1], atol=5e-3)

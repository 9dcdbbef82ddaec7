"""Every term's cost, gradient and Gauss-Newton curvature against finite differences of its residual."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels import residuals
from tests.kernels import dense

seeds = st.integers(0, 2**32 - 1)


def check(residual, count, cost, gradient, curvature):
    """A term's (cost, gradient, curvature) at x = 0 are those of its residual, a function of x (count,)."""
    at, slope = residual(np.zeros(count)), dense.jacobian(residual, count)
    assert cost == pytest.approx(0.5 * at @ at, rel=1e-12)
    for found, expected in ((gradient, slope.T @ at), (curvature, slope.T @ slope)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * max(1.0, np.abs(expected).max()))


def linearised(problem, scale2):
    """-> cost, gradient (N,) and curvature (N, N) on the pose of the markers' term"""
    position, rotation = dense.forward(problem.tree, problem.root, problem.local)
    joints = len(position)
    h, g = np.zeros((joints, 6, 6)), np.zeros((joints, 6))
    on = problem.attached
    cost = residuals.markers(on.joints, on.places, problem.seen, problem.weight, scale2, position, rotation, h, g)
    alone = residuals.marker_cost(on.joints, on.places, problem.seen, problem.weight, scale2, position, rotation)
    assert alone == pytest.approx(cost, rel=1e-13)
    through = dense.body_jacobians(problem.tree, position - position[0])
    return cost, np.einsum("jan,ja->n", through, g), np.einsum("jan,jab,jbm->nm", through, h, through)


def marker_residual(problem):
    whole = dense.pose_residuals(problem)
    return lambda x: whole(x)[: problem.seen.size]


@given(seeds, st.integers(1, 8))
def test_markers(seed, joints):
    problem = dense.frame(np.random.default_rng(seed), joints)
    check(marker_residual(problem), dense.unknowns(problem.tree), *linearised(problem, np.inf))


@given(seeds, st.floats(0.5, 100))
def test_robust_markers_slope_as_their_cost_does(seed, scale2):
    problem = dense.frame(np.random.default_rng(seed), 4)

    def cost(x):
        square = (marker_residual(problem)(x).reshape(-1, 3) ** 2).sum(1)
        return (0.5 * scale2 * square / (scale2 + square)).sum()

    count = dense.unknowns(problem.tree)
    found, gradient, _ = linearised(problem, scale2)
    slope = dense.jacobian(cost, count, step=1e-6)
    assert found == pytest.approx(cost(np.zeros(count)), rel=1e-12)
    np.testing.assert_allclose(gradient, slope, atol=1e-5 * max(1.0, np.abs(slope).max()))


def test_markers_that_weigh_nothing_are_not_looked_at():
    problem = dense.frame(np.random.default_rng(1), 4)
    problem.weight[5], problem.seen[5] = 0.0, np.nan
    without = linearised(problem, 9.0)
    problem.seen[5] = 1e3
    for found, expected in zip(linearised(problem, 9.0), without, strict=True):
        assert np.isfinite(expected).all()
        np.testing.assert_array_equal(found, expected)


@given(seeds, st.floats(0, 2.9))
def test_joint_target(seed, away):
    rng = np.random.default_rng(seed)
    local, parent = dense.rotations(rng, 2)
    vector = rng.normal(size=3)
    target = dense.Rotation.from_rotvec(-away * vector / np.linalg.norm(vector)).as_matrix() @ local
    information = dense.spd(rng, 1, 3)[0]
    upper = np.linalg.cholesky(information).T

    def residual(turn):
        after = parent.T @ dense.Rotation.from_rotvec(turn).as_matrix() @ parent @ local
        return upper @ dense.Rotation.from_matrix(after @ target.T).as_rotvec()

    own, b = np.zeros((3, 3)), np.zeros(3)
    cost = residuals.joint_target(local, target, information, parent, own, b, True)
    check(residual, 3, cost, b, own)
    untouched = np.zeros((3, 3)), np.zeros(3)
    assert residuals.joint_target(local, target, information, parent, *untouched, False) == cost
    assert not untouched[0].any()
    assert not untouched[1].any()


def test_geman_mcclure_is_plain_near_nothing_and_bounded_far_off():
    assert residuals.geman_mcclure(8.0, np.inf) == (4.0, 1.0)
    assert residuals.geman_mcclure(0.0, 4.0) == (0.0, 1.0)
    assert residuals.geman_mcclure(1e-6, 4.0) == pytest.approx((0.5e-6, 1.0), rel=1e-5)
    assert residuals.geman_mcclure(4.0, 4.0) == pytest.approx((1.0, 0.25))
    cost, weight = residuals.geman_mcclure(1e12, 4.0)
    assert cost == pytest.approx(2.0)
    assert weight < 1e-20
    assert residuals.geman_mcclure(3.0, 1e15) == pytest.approx(residuals.geman_mcclure(3.0, np.inf))


@given(st.floats(0.01, 100), st.floats(0.1, 100))
def test_geman_mcclures_weight_is_its_costs_derivative(square, scale2):
    step = 1e-5 * square
    slope = (residuals.geman_mcclure(square + step, scale2)[0] - residuals.geman_mcclure(square - step, scale2)[0]) / step
    assert residuals.geman_mcclure(square, scale2)[1] == pytest.approx(slope, rel=1e-6)

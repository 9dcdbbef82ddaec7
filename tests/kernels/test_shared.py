"""What frames say of bones and marker places, against a dense Schur complement and the cost itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.kernels.levenberg import solve_frames
from mocapfix.kernels.residuals import geman_mcclure
from mocapfix.kernels.shared import add_frames
from tests.kernels import dense

DAMPING = 1e-3  # what the pose's unknowns are given so that none is left loose
COUNT = 2  # bone groups


def grouped(seed, joints, noise=0.02):
    """-> a random frame and each joint's bone group, -1 for none"""
    rng = np.random.default_rng(seed)
    return dense.frame(rng, joints, noise=noise), rng.integers(-1, COUNT, joints)


def reshaped(problem, groups, shape):
    """-> the problem on a body whose shared unknowns (P,) are moved by `shape`"""
    stretch = np.exp(shape[0] + np.where(groups >= 0, shape[1:][groups], 0.0))
    tree = problem.tree._replace(offsets=problem.tree.offsets * stretch[:, None])
    places = problem.attached.places + shape[1 + COUNT :].reshape(-1, 3)
    return problem._replace(tree=tree, attached=problem.attached._replace(places=places))


def reduced(problem, groups, scale2):
    """-> cost, curvature (P, P) and gradient (P,) from the kernel"""
    unknowns, joints = 1 + COUNT + problem.seen.size, len(groups)
    curvature, gradient, cost = np.zeros((1, unknowns, unknowns)), np.zeros((1, unknowns)), np.zeros(1)
    add_frames(
        problem.tree, problem.attached, groups, COUNT, problem.seen[None], problem.weight[None], scale2, dense.no_pull(joints),
        dense.one(problem.pull), problem.root[None], problem.local[None], curvature, gradient, cost, 0, 1,
    )  # fmt: skip
    return cost[0], curvature[0], gradient[0]


def schur(problem, groups, scale2):
    """-> the same, from the whole Jacobian by finite differences"""
    placed = dense.markers(problem.attached, *dense.forward(problem.tree, problem.root, problem.local))
    square = problem.weight * ((placed - problem.seen) ** 2).sum(1)
    trust = np.array([geman_mcclure(each, scale2)[1] for each in square])
    trusted = problem._replace(weight=problem.weight * trust)
    shared, pose = 1 + COUNT + problem.seen.size, dense.unknowns(problem.tree)

    def residual(x):
        return dense.pose_residuals(reshaped(trusted, groups, x[:shared]))(x[shared:])

    slope, at = dense.jacobian(residual, shared + pose), residual(np.zeros(shared + pose))
    whole, gradient = slope.T @ slope, slope.T @ at
    through = whole[:shared, shared:] @ np.linalg.inv(whole[shared:, shared:] + DAMPING * np.eye(pose))
    return whole[:shared, :shared] - through @ whole[shared:, :shared], gradient[:shared] - through @ gradient[shared:]


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([np.inf, 9.0]))
def test_poses_are_eliminated_as_a_dense_schur_complement_does(seed, joints, scale2):
    problem, groups = grouped(seed, joints)
    problem.weight[1] = 0.0
    _, curvature, gradient = reduced(problem, groups, scale2)
    expected_curvature, expected_gradient = schur(problem, groups, scale2)
    np.testing.assert_allclose(curvature, expected_curvature, atol=1e-6 * np.abs(expected_curvature).max())
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-6 * np.abs(expected_gradient).max())


def test_the_gradient_is_that_of_the_cost_at_the_best_pose():
    problem, groups = grouped(7, 4)

    def solved(shape):
        trial = reshaped(problem, groups, shape)
        root, local = problem.root[None].copy(), problem.local[None].copy()
        status, iterations = np.zeros(1, int), np.zeros(1, int)
        solve_frames(
            trial.tree, trial.attached, trial.seen[None], trial.weight[None], np.full(4, np.inf), dense.no_pull(4),
            dense.one(trial.pull), root, local, 100, status, iterations, 0, 1,
        )  # fmt: skip
        return reduced(trial._replace(root=root[0], local=local[0]), groups, np.inf)

    unknowns = 1 + COUNT + problem.seen.size
    slope = dense.jacobian(lambda shape: solved(shape)[0], unknowns, step=1e-3)
    np.testing.assert_allclose(solved(np.zeros(unknowns))[2], slope, rtol=0, atol=0.02 * np.abs(slope).max())


def test_frames_add_into_their_own_rows_only():
    problem, groups = grouped(8, 3)
    unknowns = 1 + COUNT + problem.seen.size
    seen, weight = np.tile(problem.seen, (3, 1, 1)), np.tile(problem.weight, (3, 1))
    root, local = np.tile(problem.root, (3, 1)), np.tile(problem.local, (3, 1, 1, 1))
    curvature, gradient, cost = np.zeros((3, unknowns, unknowns)), np.zeros((3, unknowns)), np.zeros(3)
    add_frames(
        problem.tree, problem.attached, groups, COUNT, seen, weight, np.inf, dense.no_pull(3), dense.one(problem.pull), root,
        local, curvature, gradient, cost, 1, 2,
    )  # fmt: skip
    assert not curvature[[0, 2]].any()
    assert not gradient[[0, 2]].any()
    assert cost[1] == pytest.approx(0.5 * (dense.residuals(problem) ** 2).sum())
    assert cost[0] == cost[2] == 0

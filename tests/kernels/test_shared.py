"""What frames say of bones and marker places, against a dense Schur complement and the cost itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.kernels.shared import add_frames
from tests.kernels import dense, drawn
from tests.kernels.model import solved

DAMPING = 1e-3  # what the pose's unknowns are given so that none is left loose
COUNT = 2  # bone groups


def grouped(seed, joints):
    """-> a random frame of markers and pulls, and each joint's bone group, -1 for none"""
    rng = np.random.default_rng(seed)
    return drawn.frame(rng, joints, ["points", "targets"]), rng.integers(-1, COUNT, joints)


def reshaped(problem, groups, shape):
    """-> the problem on a body whose shared unknowns (P,) are moved by `shape`"""
    points, *others = problem.terms
    stretch = np.exp(shape[0] + np.where(groups >= 0, shape[1:][groups], 0.0))
    tree = problem.tree._replace(offsets=problem.tree.offsets * stretch[:, None])
    places = points.places + shape[1 + COUNT :].reshape(-1, 3)
    return problem._replace(tree=tree, terms=(points._replace(places=places), *others))


def unknowns(problem):
    return 1 + COUNT + 3 * len(problem.terms[0].joints)


def reduced(problem, groups, scale2):
    """-> cost, curvature (P, P) and gradient (P,) from the kernel"""
    count = unknowns(problem)
    curvature, gradient, cost = np.zeros((1, count, count)), np.zeros((1, count)), np.zeros(1)
    terms = problem.terms[0], problem.terms[drawn.KINDS.index("targets")]
    add_frames(
        problem.tree, terms, groups, COUNT, scale2, problem.root[None], problem.local[None], curvature, gradient, cost, 0, 1
    )
    return cost[0], curvature[0], gradient[0]


def schur(problem, groups, scale2):
    """-> the same, from the whole Jacobian by finite differences"""
    points, *others = problem.terms
    square = (dense.residual(points, dense.world(*problem[:1], *problem[2:])) ** 2).sum(1)
    weight = points.weight.copy()
    weight[weight > 0] *= dense.loss(points.loss, square, scale2)[1]
    trusted = problem._replace(terms=(points._replace(weight=weight), *others))
    shared, pose = unknowns(problem), dense.unknowns(problem)

    def residual(x):
        after = dense.moved(reshaped(trusted, groups, x[:shared]), x[shared:])
        at = dense.world(*after[:1], *after[2:])
        return np.concatenate([dense.residual(term, at).ravel() for term in after.terms])

    slope, at = dense.jacobian(residual, shared + pose), residual(np.zeros(shared + pose))
    whole, gradient = slope.T @ slope, slope.T @ at
    through = whole[:shared, shared:] @ np.linalg.inv(whole[shared:, shared:] + DAMPING * np.eye(pose))
    return whole[:shared, :shared] - through @ whole[shared:, :shared], gradient[:shared] - through @ gradient[shared:]


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([np.inf, 9.0]))
def test_poses_are_eliminated_as_a_dense_schur_complement_does(seed, joints, scale2):
    problem, groups = grouped(seed, joints)
    problem.terms[0].weight[0, 1] = 0.0
    _, curvature, gradient = reduced(problem, groups, scale2)
    expected_curvature, expected_gradient = schur(problem, groups, scale2)
    np.testing.assert_allclose(curvature, expected_curvature, atol=1e-6 * np.abs(expected_curvature).max())
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-6 * np.abs(expected_gradient).max())


def test_the_gradient_is_that_of_the_cost_at_the_best_pose():
    problem, groups = grouped(7, 4)

    def best(shape):
        trial = reshaped(problem, groups, shape)
        root, local, *_ = solved(trial, np.full(4, np.inf), most=100)
        return reduced(trial._replace(root=root[0], local=local[0]), groups, np.inf)

    slope = dense.jacobian(lambda shape: best(shape)[0], unknowns(problem), step=1e-3)
    np.testing.assert_allclose(best(np.zeros(unknowns(problem)))[2], slope, rtol=0, atol=0.02 * np.abs(slope).max())


def test_frames_add_into_their_own_rows_only():
    problem, groups = grouped(8, 3)
    points, count = problem.terms[0], unknowns(problem)
    both = points._replace(seen=np.tile(points.seen, (3, 1, 1)), weight=np.tile(points.weight, (3, 1)))
    root, local = np.tile(problem.root, (3, 1)), np.tile(problem.local, (3, 1, 1, 1))
    curvature, gradient, cost = np.zeros((3, count, count)), np.zeros((3, count)), np.zeros(3)
    terms = both, problem.terms[drawn.KINDS.index("targets")]
    add_frames(problem.tree, terms, groups, COUNT, np.inf, root, local, curvature, gradient, cost, 1, 2)
    assert not curvature[[0, 2]].any()
    assert not gradient[[0, 2]].any()
    assert cost[1] == pytest.approx(dense.cost(problem))
    assert cost[0] == cost[2] == 0

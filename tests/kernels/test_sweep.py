"""The sweep in linear time against the same quadratic written out whole and solved densely."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels import sweep
from tests.kernels import dense

seeds, sizes = st.integers(0, 2**32 - 1), st.integers(1, 16)


class Quadratic:
    """A random quadratic on a random tree, as the sweep takes it and as one matrix.

    Curvature on bodies is that of random markers, from none to three to a body; on joints it is random; on the root full.
    """

    def __init__(self, seed, joints, damping):
        rng = np.random.default_rng(seed)
        self.tree = dense.tree(rng, joints)
        self.arm, self.mu = np.r_[np.zeros((1, 3)), rng.normal(size=(joints - 1, 3))], damping
        self.h, self.g = np.zeros((joints, 6, 6)), rng.normal(size=(joints, 6))
        for j in np.repeat(np.arange(joints), rng.integers(0, 4, joints)):
            point = np.hstack([-dense.cross(rng.normal(size=3)), np.eye(3)])
            self.h[j] += rng.uniform(0.1, 10) * point.T @ point
        self.h[0] += dense.spd(rng, 1, 6)[0]
        self.own, self.b = dense.spd(rng, joints, 3), rng.normal(size=(joints, 3))
        self.own[0] = self.b[0] = 0.0
        self.jacobian = dense.body_jacobians(self.tree, self.arm)

    def whole(self):
        """-> curvature (N, N) and gradient (N,)"""
        turning = np.flatnonzero(self.tree.free[1:]) + 1
        curvature = np.einsum("jan,jab,jbm->nm", self.jacobian, self.h, self.jacobian) + self.mu * np.eye(self.jacobian.shape[2])
        gradient = np.einsum("jan,ja->n", self.jacobian, self.g)
        for n, j in enumerate(turning):
            at = slice(6 + 3 * n, 9 + 3 * n)
            curvature[at, at] += self.own[j]
            gradient[at] += self.b[j]
        return curvature, gradient

    def factored(self):
        """-> root's inverse, gains and inverse own curvatures"""
        joints = len(self.arm)
        h, gain, inverse_own = self.h.copy(), np.empty((joints, 6, 3)), np.empty((joints, 3, 3))
        sweep.factor(self.tree.parents, self.tree.free, self.arm, h, self.own, self.mu, gain, inverse_own)
        return h[0], gain, inverse_own


def close(found, expected, relative):
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * np.abs(expected).max(initial=1e-3))


@given(seeds, sizes, st.sampled_from([0.0, 1e-3, 1.0, 100.0]))
def test_the_step_is_the_dense_one(seed, joints, damping):
    problem = Quadratic(seed, joints, damping)
    twist, turn = np.empty((joints, 6)), np.empty((joints, 3))
    factors = problem.factored()
    sweep.solve(problem.tree.parents, problem.tree.free, problem.arm, *factors, problem.g.copy(), problem.b, twist, turn)
    curvature, gradient = problem.whole()
    x = np.linalg.solve(curvature, -gradient)
    close(twist, problem.jacobian @ x, 1e-9)
    close(turn[1:][problem.tree.free[1:]], x[6:].reshape(-1, 3), 1e-9)
    np.testing.assert_array_equal(turn[1:][~problem.tree.free[1:]], 0)
    np.testing.assert_array_equal(turn[0], 0)


@given(seeds, sizes)
def test_covariances_are_the_dense_inverses_blocks(seed, joints):
    problem = Quadratic(seed, joints, 0.0)
    spread, turn_variance = np.empty((joints, 6, 6)), np.empty(joints)
    sweep.covariance(problem.tree.parents, problem.tree.free, problem.arm, *problem.factored(), spread, turn_variance)
    inverse = np.linalg.inv(problem.whole()[0])
    close(spread, problem.jacobian @ inverse @ np.swapaxes(problem.jacobian, 1, 2), 1e-9)
    diagonal = np.diag(inverse)
    close(turn_variance[0], diagonal[:3].mean(), 1e-9)
    close(turn_variance[1:][problem.tree.free[1:]], diagonal[6:].reshape(-1, 3).mean(1), 1e-9)
    np.testing.assert_array_equal(turn_variance[1:][~problem.tree.free[1:]], 0)

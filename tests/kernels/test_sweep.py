"""The direction of the sweep against a dense solution of the same quadratic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.levenberg_marquardt import compute_direction
from mocapfix.kernels.normal_equations import allocate_workspace
from tests.kernels import dense_oracle, random_terms
from tests.kernels.solver_runs import build_workspace

seeds, sizes, dampings = st.integers(0, 2**32 - 1), st.integers(1, 16), st.sampled_from([1e-3, 1.0, 100.0])
ROUNDING = np.finfo(float).eps


def random_work(rng, tree, unknowns, rows):
    """Return a workspace with random positive semidefinite equations, sparse as with terms on some bodies only."""
    joints = len(tree.parents)
    work = allocate_workspace(joints, unknowns, rows)
    s = work.equations
    s.h_shared[:] = 0.0
    half = rng.normal(size=(joints, 6, 6)) * rng.integers(0, 2, (joints, 6, 1))
    s.h[:] = np.swapaxes(half, 1, 2) @ half
    half = rng.normal(size=(joints, 3, 3 + unknowns)) * rng.integers(0, 2, (joints, 3, 1))
    both = np.swapaxes(half, 1, 2) @ half
    s.h_joint[:], s.h_joint_shared[:], s.h_shared[:] = both[:, :3, :3], both[:, :3, 3:], both[:, 3:, 3:].sum(0)
    s.h[0, :3, :3] += s.h_joint[0]  # the root's own turn is part of its twist
    s.h_joint[0] = 0.0
    for each in (s.g, s.g_joint, s.g_shared, s.row_twist, s.row_joint, s.row_residual):
        each[:] = rng.normal(size=each.shape)
    s.lever_arm[:] = rng.normal(size=s.lever_arm.shape)
    s.lever_arm[0] = s.g_joint[0] = s.row_joint[:, 0] = 0.0
    return work


def check(tree, work, damping):
    """Check that the direction is the dense one and predicts the model's decrease.

    The tolerance is 1e-9 of the largest number or, where even the dense solve is less accurate, the rounding error of its N
    numbers times the condition number; that of the tree without its rows if larger, as Woodbury's formula solves with it.
    """
    gradient, curvature = dense_oracle.assemble_equations(tree, work.equations)
    twist, turn, shared = dense_oracle.compute_twist_maps(tree, work.equations)
    damped = curvature + damping * np.eye(len(gradient))
    rows = dense_oracle.compute_row_map(tree, work.equations)
    condition = max(np.linalg.cond(damped), np.linalg.cond(damped - rows.T @ rows))
    x, relative = np.linalg.solve(damped, -gradient), max(1e-9, 10 * len(gradient) * ROUNDING * condition)
    promised, largest = compute_direction(tree, work, damping), np.abs(x).max()
    for found, expected in ((work.step.twist, twist @ x), (work.step.joint_turn, turn @ x), (work.step.shared, shared @ x)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=relative * np.abs(expected).max(initial=largest))
    assert promised == pytest.approx(-gradient @ x - 0.5 * x @ curvature @ x, rel=relative, abs=1e-12)


@given(seeds, sizes, st.integers(0, 10), st.none() | st.integers(0, 4), dampings)
def test_direction_of_any_quadratic(seed, joints, unknowns, rows, damping):
    rng = np.random.default_rng(seed)
    tree = random_terms.draw_tree(rng, joints)
    check(tree, random_work(rng, tree, unknowns, rows), damping)


@given(seeds, sizes, st.integers(0, 32), st.sampled_from([np.inf, 9.0]), dampings)
def test_direction_of_all_terms_with_a_code(seed, joints, codes, scale2, damping):
    frame = random_terms.draw_frame(np.random.default_rng(seed), joints, codes=codes)
    check(frame.tree, build_workspace(frame, scale2)[1], damping)


@given(seeds, sizes, st.sampled_from([1e-4, 1e-7, 1e-10, 1e-12]), st.sampled_from([1e4, 1e8]))
def test_direction_of_nearly_unconstrained_bodies(seed, joints, share, sharp):
    """A few markers, some with small sd: many unknowns are constrained by the damping alone, a `share` of the largest curvature.

    The condition number is 1 / share, and the sweep must lose no more digits by it than a dense solve does.
    """
    rng = np.random.default_rng(seed)
    frame = random_terms.draw_frame(rng, joints, ["points", "joint_limits", "distances"])
    points = frame.terms[0]
    points.weight[:, ::2] = sharp
    points.weight[:, rng.random(points.weight.shape[1]) < 0.5] = 0.0
    _, work = build_workspace(frame)
    largest = np.linalg.eigvalsh(dense_oracle.assemble_equations(frame.tree, work.equations)[1]).max()
    check(frame.tree, work, share * max(largest, 1.0))


def test_unconstrained_joint_stays_and_does_not_spoil_the_others():
    """Without damping the joint's own block is singular."""
    rng = np.random.default_rng(5)
    tree = random_terms.draw_tree(rng, 3)._replace(parents=np.array([-1, 0, 0]), free=np.ones(3, bool))
    work = random_work(rng, tree, 0, None)
    work.equations.h[:] = random_terms.draw_spd(rng, 3, 6)
    work.equations.h_joint[1:] = random_terms.draw_spd(rng, 2, 3)
    for loose in (work.equations.h, work.equations.g, work.equations.h_joint, work.equations.g_joint):
        loose[2] = 0.0
    gradient, curvature = dense_oracle.assemble_equations(tree, work.equations)
    compute_direction(tree, work, 0.0)
    np.testing.assert_array_equal(work.step.joint_turn[2], 0)
    held = slice(0, 9)
    x = np.linalg.solve(curvature[held, held], -gradient[held])
    np.testing.assert_allclose(np.r_[work.step.twist[0], work.step.joint_turn[1]], x, rtol=1e-9)

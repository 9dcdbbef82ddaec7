"""Pose uncertainty against the inverse of the dense curvature, and against the errors of solves of known poses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.sweep import MIN_INFORMATION
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.model.motion import FrameStatus
from tests.kernels import dense_oracle, random_terms
from tests.kernels.solver_runs import build_workspace, compute_uncertainty, solve_frames_from

PLAIN = np.array([np.inf])
ROUNDING = np.finfo(float).eps


def spread(frame, scale2):
    """Return the same as `predicted`, from the inverse of the whole curvature; and its condition"""
    _, work = build_workspace(frame, scale2)
    curvature = dense_oracle.assemble_equations(frame.tree, work.equations)[1] + MIN_INFORMATION * np.eye(
        dense_oracle.count_unknowns(frame)
    )
    inverse, (twist, turn, _) = np.linalg.inv(curvature), dense_oracle.compute_twist_maps(frame.tree, work.equations)
    turn[0], points = twist[0, :3], frame.terms[0]
    at = dense_oracle.compute_world(*frame[:1], *frame[2:])

    def shift(bodies, places):
        arms = dense_oracle.compute_point_positions(bodies, places, at) - at.position[0]
        return np.stack(
            [twist[j, 3:] - dense_oracle.build_cross_matrix(x) @ twist[j, :3] for j, x in zip(bodies, arms, strict=True)]
        )

    every = np.arange(len(frame.local))
    each = shift(points.joints, points.offsets), shift(every, np.zeros((len(every), 3))), turn, twist[:1, 3:]
    markers, joints, turns, root = (np.einsum("kan,nm,kam->k", one, inverse, one) / 3 for one in each)
    return (np.sqrt(markers), np.sqrt(joints), turns, root), np.linalg.cond(curvature)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.sampled_from([0, 5]), st.sampled_from([np.inf, 9.0]))
def test_variances_equal_the_dense_inverse(seed, joints, codes, scale2):
    frame = random_terms.draw_frame(np.random.default_rng(seed), joints, codes=codes)
    expected, condition = spread(frame, scale2)
    for found, should in zip(compute_uncertainty(frame, scale2), expected, strict=True):
        np.testing.assert_allclose(found[0], should, rtol=1e-6, atol=10 * ROUNDING * condition * should.max())


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_variances_with_few_terms(seed, joints):
    """Much is held by next to nothing, 1e7 times less than the rest: digits are lost on the way down the tree."""
    frame = random_terms.draw_frame(np.random.default_rng(seed), joints, ["points", "latent_code"], codes=2)
    frame.terms[0].weight[:, 2:] = 0.0
    expected, _ = spread(frame, np.inf)
    for found, should in zip(compute_uncertainty(frame, np.inf), expected, strict=True):
        np.testing.assert_allclose(found[0], should, rtol=1e-4, atol=1e-5 * should.max())


def test_errors_are_as_large_as_predicted():
    """Poses drawn from the prior, their markers with noise and some of them hidden: the solve's errors have its own spread."""
    rng, frames, joints = np.random.default_rng(6), 500, 7
    frame = random_terms.draw_frame(rng, joints, [])
    body, (root_sd, joint_sd, noise) = frame.tree, (0.02, 0.05, 0.004)
    vectors, shifts = rng.normal(0, joint_sd, (frames, joints, 3)), rng.normal(0, root_sd, (frames, 3))
    vectors[:, ~body.free] = 0.0
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, joints, 3, 3) @ frame.local
    root = frame.root + shifts
    on, places = np.repeat(np.arange(joints), 3), rng.normal(0, 0.15, (3 * joints, 3))

    def carried(root, local):
        return np.stack(
            [
                dense_oracle.compute_point_positions(on, places, dense_oracle.compute_world(body, *pose))
                for pose in zip(root, local, strict=True)
            ]
        )

    def joints_of(root, local):
        return np.stack([dense_oracle.compute_world(body, *pose).position for pose in zip(root, local, strict=True)])

    truth = carried(root, local)
    weight = np.full(truth.shape[:2], noise**-2)
    weight[:, np.r_[0, 4, 5, np.arange(9, 15)]] = 0.0  # two joints' markers altogether
    seen = random_terms.PointTerm(on, places, truth + rng.normal(0, noise, truth.shape), weight)
    weight = np.full((1, joints), joint_sd**-2)
    prior = TrackingTerm(frame.local[None].copy(), weight, frame.root[None].copy(), np.array([root_sd**-2]))
    problem = frame._replace(terms=random_terms.build_terms(joints, frames, points=seen, tracking=prior))
    root_found, found, shared, status, _ = solve_frames_from(problem, PLAIN, frames)
    assert (status == FrameStatus.CONVERGED).all()
    marker_sd, joint_sd, joint_var, root_var = compute_uncertainty(problem, np.inf, root_found, found, shared)

    def agree(errors, sd):
        np.testing.assert_allclose(np.sqrt((errors**2).mean((0, -1))), np.sqrt((sd**2).mean(0)), rtol=0.15)

    agree(carried(root_found, found) - truth, marker_sd)
    agree(joints_of(root_found, found) - joints_of(root, local), joint_sd)
    agree(root_found - root, np.sqrt(root_var))
    relative = (found @ np.swapaxes(local, 2, 3)).reshape(-1, 3, 3)
    agree(Rotation.from_matrix(relative).as_rotvec().reshape(frames, joints, 3)[:, body.free], np.sqrt(joint_var[:, body.free]))
    assert marker_sd[:, 9:15].mean() > 2 * marker_sd[:, 20].mean()

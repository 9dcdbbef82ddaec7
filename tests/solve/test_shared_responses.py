"""Responses to shape unknowns against a dense Schur complement and against the cost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.solve.minimise import compute_shared_responses
from mocapfix.solve.pose_problem import PoseProblem
from mocapfix.solve.terms import MarkerAttachment, ShapeDeformations, build_no_tracking
from tests.kernels import dense_oracle, random_terms

DAMPING = 1e-3  # what the pose's unknowns are given so that none is left loose
COUNT = 3  # unknowns beside the markers' own places
SD = 0.02  # metres, one for all markers
PLAIN = np.inf  # no robust scale
MARKERS = 9


def shared(seed, joints, hidden=()):
    """Return a random frame of markers of equal weight and priors, and deformations in which its offsets and places change"""
    rng = np.random.default_rng(seed)
    frame = random_terms.draw_frame(rng, joints, random_terms.SOLVER_KINDS)
    points, *pulls = frame.terms
    weight = np.full((1, MARKERS), SD**-2)
    weight[:, list(hidden)] = 0.0
    robust_points = points._replace(weight=weight, loss=random_terms.GEMAN_MCCLURE)
    pulls[1] = pulls[1]._replace(mean_vectors=rng.normal(0, 0.2, (joints, 3)))
    deformations = ShapeDeformations(rng.normal(0, 0.3, (COUNT, joints, 3)), rng.normal(0, 0.1, (COUNT, MARKERS, 3)))
    return frame._replace(terms=(robust_points, *pulls)), deformations


def changed(frame, deformations, unknowns):
    """Return the frame on a body whose shared unknowns (Q,) are moved"""
    points, tracking, targets, limits = frame.terms
    offsets = frame.tree.offsets + np.tensordot(unknowns[:COUNT], deformations.joint_offsets, 1)
    own = COUNT + 3 * MARKERS
    places = points.offsets + np.tensordot(unknowns[:COUNT], deformations.marker_offsets, 1) + unknowns[COUNT:own].reshape(-1, 3)
    vectors = targets.mean_vectors.copy()
    vectors[np.flatnonzero(frame.tree.free)[1:]] += unknowns[own:].reshape(-1, 3)
    terms = points._replace(offsets=places), tracking, targets._replace(mean_vectors=vectors), limits
    return frame._replace(tree=frame.tree._replace(offsets=offsets), terms=terms)


def count(frame):
    """Return Q"""
    return COUNT + 3 * MARKERS + 3 * (int(frame.tree.free.sum()) - 1)


def problem_of(frame, frames=1):
    """Return the same as the pose problem of a take that repeats the frame"""
    points, _, prior, limits = frame.terms
    markers, solver_mask = np.tile(points.measured, (frames, 1, 1)), np.tile(points.weight > 0, (frames, 1))
    return PoseProblem(frame.tree, MarkerAttachment(points.joints, points.offsets), markers, solver_mask, SD, prior, limits)


def respond(frame, deformations, scale, frames=1):
    root, local = np.tile(frame.root, (frames, 1)), np.tile(frame.local, (frames, 1, 1, 1))
    problem = problem_of(frame, frames)
    squared_scale = problem.normalise_robust_scales((scale,))[0]
    terms = problem.build_terms(frame.terms[1])
    found = compute_shared_responses(problem.tree, terms, squared_scale, (root, local), has_responses=True)
    basis = build_basis(frame, deformations)
    curvature, gradient = basis.T @ found.curvature @ basis, basis.T @ found.gradient
    responses = found.marker_response @ basis, found.joint_response @ basis
    return found._replace(curvature=curvature, gradient=gradient, marker_response=responses[0], joint_response=responses[1])


def build_basis(frame, deformations):
    """Return the changes (U, Q) of the body's offsets and mean pose with the shared unknowns."""
    deformed = np.hstack([each.reshape(COUNT, -1) for each in deformations]).T
    basis = np.zeros((3 * len(frame.tree.parents) + count(frame) - COUNT, count(frame)))
    basis[: len(deformed), :COUNT] = deformed
    basis[3 * len(frame.tree.parents) :, COUNT:] = np.eye(count(frame) - COUNT)
    return basis


def trusted(frame, scale):
    """Return the frame with robust weights instead of a robust cost"""
    points, *pulls = frame.terms
    square = points.weight[0] * (
        (dense_oracle.compute_point_positions(points.joints, points.offsets, at(frame)) - points.measured[0]) ** 2
    ).sum(1)
    inlier_weight = dense_oracle.compute_loss(points.loss, square, (scale / SD) ** 2)[1]
    return frame._replace(terms=(points._replace(weight=points.weight * inlier_weight), *pulls))


def at(frame):
    return dense_oracle.compute_world(*frame[:1], *frame[2:])


def jacobian(frame, deformations):
    """Return (rows, Q + N) of all residuals, shared unknowns first, then the pose's; and the residuals (rows,)"""
    unknowns, pose = count(frame), dense_oracle.count_unknowns(frame)

    def residual(x):
        after = dense_oracle.apply_change(changed(frame, deformations, x[:unknowns]), x[unknowns:])
        return np.concatenate([dense_oracle.compute_residual(term, at(after)).ravel() for term in after.terms])

    return dense_oracle.compute_jacobian(residual, unknowns + pose), residual(np.zeros(unknowns + pose))


def compute_adaptation(slope, unknowns):
    """Return the response (N, Q) of the pose to the shared unknowns."""
    of_pose = slope[:, unknowns:]
    return -np.linalg.solve(of_pose.T @ of_pose + DAMPING * np.eye(of_pose.shape[1]), of_pose.T @ slope[:, :unknowns])


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([PLAIN, 3 * SD]))
def test_elimination_equals_a_dense_schur_complement(seed, joints, scale):
    frame, deformations = shared(seed, joints, hidden=[1])
    found = respond(frame, deformations, scale)
    curvature, gradient = found.curvature, found.gradient
    slope, residuals = jacobian(trusted(frame, scale), deformations)
    unknowns = len(gradient)
    through = slope[:, :unknowns] + slope[:, unknowns:] @ compute_adaptation(slope, unknowns)
    expected, fall = slope[:, :unknowns].T @ through, through.T @ residuals
    np.testing.assert_allclose(curvature, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, fall, atol=1e-6 * np.abs(fall).max())
    assert found.cost[0] == pytest.approx(dense_oracle.compute_cost(frame, (scale / SD) ** 2))


def test_responses_equal_the_adapted_poses_motion():
    frame, deformations = shared(3, 5, hidden=[4])
    found, (slope, _) = respond(frame, deformations, PLAIN), jacobian(frame, deformations)
    unknowns = found.joint_response.shape[3]
    adaptation = np.r_[np.eye(unknowns), compute_adaptation(slope, unknowns)]

    def placed(x):
        after = dense_oracle.apply_change(changed(frame, deformations, x[:unknowns]), x[unknowns:])
        points, there = after.terms[0], at(after)
        return np.r_[there.position, dense_oracle.compute_point_positions(points.joints, points.offsets, there)]

    moves = np.moveaxis(dense_oracle.compute_jacobian(placed, len(adaptation)) @ adaptation, -1, 0)
    np.testing.assert_allclose(np.moveaxis(found.joint_response[0], -1, 0), moves[:, :5], atol=1e-6)
    rotation = at(frame).rotation[frame.terms[0].joints]
    np.testing.assert_allclose(found.marker_response[0], np.einsum("kba,qkb->kaq", rotation, moves[:, 5:]), atol=1e-6)


def test_gradient_is_that_of_the_minimised_cost():
    frame, deformations = shared(7, 4)

    def solved(unknowns):
        trial = changed(frame, deformations, unknowns)
        start = frame.root[None], frame.local[None]
        found = problem_of(trial).minimise(start, (PLAIN, PLAIN, PLAIN), frame.terms[1], max_iterations=100)
        return respond(trial._replace(root=found.root_position[0], local=found.local_rotations[0]), deformations, PLAIN)

    unknowns = count(frame)
    slope = dense_oracle.compute_jacobian(lambda x: solved(x).cost[0], unknowns, step=1e-3)
    gradient = solved(np.zeros(unknowns)).gradient
    np.testing.assert_allclose(gradient, slope, rtol=0, atol=0.02 * np.abs(slope).max())


def test_repeated_frames_add_up():
    frame, deformations = shared(8, 3)
    one, three = respond(frame, deformations, PLAIN), respond(frame, deformations, PLAIN, frames=3)
    np.testing.assert_allclose(three.cost, np.full(3, dense_oracle.compute_cost(frame)))
    for once, thrice in ((one.curvature, three.curvature), (one.gradient, three.gradient)):
        np.testing.assert_allclose(thrice, 3 * once, rtol=1e-9, atol=1e-9 * np.abs(once).max())


@pytest.mark.parametrize("frames", [1, 4])
def test_missing_marker_has_no_curvature_and_follows_its_joint(frames):
    frame, deformations = shared(9, 3, hidden=[2])
    found = respond(frame._replace(terms=(frame.terms[0], build_no_tracking(3), *frame.terms[2:])), deformations, PLAIN, frames)
    mine = slice(COUNT + 6, COUNT + 9)
    assert not found.curvature[mine].any()
    assert not found.joint_response[..., mine].any()
    np.testing.assert_allclose(found.marker_response[:, 2, :, mine], np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)

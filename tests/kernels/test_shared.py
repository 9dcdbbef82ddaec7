"""What frames say of bones and marker places, against a dense Schur complement and the cost itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.kernels.schur import ShapeDeformations, compute_shared_responses, reduce_shared_equations
from mocapfix.solve.pose_problem import MarkerAttachment, PoseProblem, build_no_tracking
from tests.kernels import dense, drawn

DAMPING = 1e-3  # what the pose's unknowns are given so that none is left loose
COUNT = 3  # unknowns beside the markers' own places
SD = 0.02  # metres, one for all markers
PLAIN = np.inf  # no robust scale
MARKERS = 9


def shared(seed, joints, hidden=()):
    """-> a random frame of markers that weigh alike and pulls, and deformations in which its offsets and places change"""
    rng = np.random.default_rng(seed)
    frame = drawn.frame(rng, joints, drawn.FEW)
    points, *pulls = frame.terms
    weight = np.full((1, MARKERS), SD**-2)
    weight[:, list(hidden)] = 0.0
    alike = points._replace(weight=weight, loss=drawn.GEMAN_MCCLURE)
    pulls[1] = pulls[1]._replace(vectors=rng.normal(0, 0.2, (joints, 3)))
    deformations = ShapeDeformations(rng.normal(0, 0.3, (COUNT, joints, 3)), rng.normal(0, 0.1, (COUNT, MARKERS, 3)))
    return frame._replace(terms=(alike, *pulls)), deformations


def changed(frame, deformations, unknowns):
    """-> the frame on a body whose shared unknowns (Q,) are moved"""
    points, course, targets, limits = frame.terms
    offsets = frame.tree.joint_offsets + np.tensordot(unknowns[:COUNT], deformations.joint_offsets, 1)
    own = COUNT + 3 * MARKERS
    places = points.places + np.tensordot(unknowns[:COUNT], deformations.places, 1) + unknowns[COUNT:own].reshape(-1, 3)
    vectors = targets.vectors.copy()
    vectors[np.flatnonzero(frame.tree.free)[1:]] += unknowns[own:].reshape(-1, 3)
    terms = points._replace(places=places), course, targets._replace(vectors=vectors), limits
    return frame._replace(tree=frame.tree._replace(joint_offsets=offsets), terms=terms)


def count(frame):
    """-> Q"""
    return COUNT + 3 * MARKERS + 3 * (int(frame.tree.free.sum()) - 1)


def problem_of(frame, frames=1):
    """-> the same as the pose problem of a take that repeats the frame"""
    points, _, prior, limits = frame.terms
    markers, listened = np.tile(points.seen, (frames, 1, 1)), np.tile(points.weight > 0, (frames, 1))
    return PoseProblem(frame.tree, MarkerAttachment(points.joints, points.places), markers, listened, SD, prior, limits)


def respond(frame, deformations, scale, frames=1):
    root, local = np.tile(frame.root, (frames, 1)), np.tile(frame.local, (frames, 1, 1, 1))
    return compute_shared_responses(problem_of(frame, frames), deformations, frame.terms[1], scale, root, local)


def trusted(frame, scale):
    """-> the frame with robust weights instead of a robust cost"""
    points, *pulls = frame.terms
    square = points.weight[0] * ((dense.placed(points.joints, points.places, at(frame)) - points.seen[0]) ** 2).sum(1)
    trust = dense.loss(points.loss, square, (scale / SD) ** 2)[1]
    return frame._replace(terms=(points._replace(weight=points.weight * trust), *pulls))


def at(frame):
    return dense.world(*frame[:1], *frame[2:])


def jacobian(frame, deformations):
    """-> (rows, Q + N) of all residuals, shared unknowns first, then the pose's; and the residuals (rows,)"""
    unknowns, pose = count(frame), dense.unknowns(frame)

    def residual(x):
        after = dense.moved(changed(frame, deformations, x[:unknowns]), x[unknowns:])
        return np.concatenate([dense.residual(term, at(after)).ravel() for term in after.terms])

    return dense.jacobian(residual, unknowns + pose), residual(np.zeros(unknowns + pose))


def loose(slope, unknowns):
    """-> (N, Q) how the pose gives way to the shared unknowns"""
    of_pose = slope[:, unknowns:]
    return -np.linalg.solve(of_pose.T @ of_pose + DAMPING * np.eye(of_pose.shape[1]), of_pose.T @ slope[:, :unknowns])


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([PLAIN, 3 * SD]))
def test_poses_are_eliminated_as_a_dense_schur_complement_does(seed, joints, scale):
    frame, deformations = shared(seed, joints, hidden=[1])
    found = respond(frame, deformations, scale)
    curvature, gradient = reduce_shared_equations(found)
    slope, residuals = jacobian(trusted(frame, scale), deformations)
    unknowns = len(gradient)
    through = slope[:, :unknowns] + slope[:, unknowns:] @ loose(slope, unknowns)
    expected, fall = slope[:, :unknowns].T @ through, through.T @ residuals
    np.testing.assert_allclose(curvature, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, fall, atol=1e-6 * np.abs(fall).max())
    assert found.cost[0] == pytest.approx(dense.cost(frame, (scale / SD) ** 2))


def test_joints_and_markers_go_where_the_pose_that_gives_way_takes_them():
    frame, deformations = shared(3, 5, hidden=[4])
    found, (slope, _) = respond(frame, deformations, PLAIN), jacobian(frame, deformations)
    unknowns = found.joint_response.shape[1]
    give = np.r_[np.eye(unknowns), loose(slope, unknowns)]

    def placed(x):
        after = dense.moved(changed(frame, deformations, x[:unknowns]), x[unknowns:])
        points, there = after.terms[0], at(after)
        return np.r_[there.position, dense.placed(points.joints, points.places, there)]

    moves = np.moveaxis(dense.jacobian(placed, len(give)) @ give, -1, 0)
    np.testing.assert_allclose(found.joint_response[0], moves[:, :5], atol=1e-6)
    rotation = at(frame).rotation[frame.terms[0].joints]
    np.testing.assert_allclose(found.marker_response[0, :-1], np.einsum("kba,qkb->qka", rotation, moves[:, 5:]), atol=1e-6)


def test_the_gradient_is_that_of_the_cost_at_the_best_pose():
    frame, deformations = shared(7, 4)

    def solved(unknowns):
        trial = changed(frame, deformations, unknowns)
        root, local = frame.root[None].copy(), frame.local[None].copy()
        problem_of(trial).solve(root, local, frame.terms[1], (PLAIN, PLAIN, PLAIN), 100)
        return respond(trial._replace(root=root[0], local=local[0]), deformations, PLAIN)

    unknowns = count(frame)
    slope = dense.jacobian(lambda x: solved(x).cost[0], unknowns, step=1e-3)
    gradient = reduce_shared_equations(solved(np.zeros(unknowns)))[1]
    np.testing.assert_allclose(gradient, slope, rtol=0, atol=0.02 * np.abs(slope).max())


def test_frames_that_say_the_same_say_it_as_often():
    frame, deformations = shared(8, 3)
    one, three = respond(frame, deformations, PLAIN), respond(frame, deformations, PLAIN, frames=3)
    np.testing.assert_allclose(three.cost, np.full(3, dense.cost(frame)))
    for once, thrice in zip(reduce_shared_equations(one), reduce_shared_equations(three), strict=True):
        np.testing.assert_allclose(thrice, 3 * once, rtol=1e-9, atol=1e-9 * np.abs(once).max())


@pytest.mark.parametrize("frames", [1, 4])
def test_a_marker_that_is_not_seen_presses_nothing_and_goes_along(frames):
    frame, deformations = shared(9, 3, hidden=[2])
    found = respond(frame._replace(terms=(frame.terms[0], build_no_tracking(3), *frame.terms[2:])), deformations, PLAIN, frames)
    mine = slice(COUNT + 6, COUNT + 9)
    assert not reduce_shared_equations(found)[0][mine].any()
    assert not found.joint_response[:, mine].any()
    np.testing.assert_allclose(found.marker_response[:, mine, 2], np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)

"""What frames say of bones and marker places, against a dense Schur complement and the cost itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.kernels.problem import Problem
from mocapfix.kernels.residuals import geman_mcclure
from mocapfix.kernels.shared import Directions, reduced, responses
from tests.kernels import dense

DAMPING = 1e-3  # what the pose's unknowns are given so that none is left loose
COUNT = 3  # unknowns beside the markers' own places
SD = 0.02  # metres, one for all markers
STILL = np.inf  # no robust scale


def shared(seed, joints, noise=0.02):
    """-> a random frame whose markers weigh alike, and directions along which its offsets and places change"""
    rng = np.random.default_rng(seed)
    frame = dense.frame(rng, joints, noise=noise)
    directions = Directions(rng.normal(0, 0.3, (COUNT, joints, 3)), rng.normal(0, 0.1, (COUNT, len(frame.seen), 3)))
    return frame._replace(weight=np.full(len(frame.seen), 1 / SD**2)), directions


def changed(frame, directions, unknowns):
    """-> the frame on a body whose shared unknowns (Q,) are moved"""
    offsets = frame.tree.offsets + np.tensordot(unknowns[:COUNT], directions.offsets, 1)
    places = frame.attached.places + np.tensordot(unknowns[:COUNT], directions.places, 1) + unknowns[COUNT:].reshape(-1, 3)
    return frame._replace(tree=frame.tree._replace(offsets=offsets), attached=frame.attached._replace(places=places))


def problem_of(frame, frames=1):
    """-> the same as the pose problem of a take that repeats the frame"""
    markers, listened = np.tile(frame.seen, (frames, 1, 1)), np.tile(frame.weight > 0, (frames, 1))
    return Problem(frame.tree, frame.attached, markers, listened, SD, dense.one(frame.pull))


def respond(frame, directions, scale, frames=1):
    root, local = np.tile(frame.root, (frames, 1)), np.tile(frame.local, (frames, 1, 1, 1))
    return responses(problem_of(frame, frames), directions, dense.no_pull(len(frame.local)), scale, root, local)


def trusted(frame, scale):
    """-> the frame with robust weights instead of a robust cost"""
    placed = dense.markers(frame.attached, *dense.forward(frame.tree, frame.root, frame.local))
    square = frame.weight * ((placed - frame.seen) ** 2).sum(1)
    trust = np.array([geman_mcclure(each, (scale / SD) ** 2)[1] for each in square])
    return frame._replace(weight=frame.weight * trust)


def jacobian(frame, directions):
    """-> (rows, Q + N) of all residuals, shared unknowns first, then the pose's; and the residuals (rows,)"""
    unknowns, pose = COUNT + frame.seen.size, dense.unknowns(frame.tree)

    def residual(x):
        return dense.pose_residuals(changed(frame, directions, x[:unknowns]))(x[unknowns:])

    return dense.jacobian(residual, unknowns + pose), residual(np.zeros(unknowns + pose))


def loose(slope, unknowns):
    """-> (N, Q) how the pose gives way to the shared unknowns"""
    of_pose = slope[:, unknowns:]
    return -np.linalg.solve(of_pose.T @ of_pose + DAMPING * np.eye(of_pose.shape[1]), of_pose.T @ slope[:, :unknowns])


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([STILL, 3 * SD]))
def test_poses_are_eliminated_as_a_dense_schur_complement_does(seed, joints, scale):
    frame, directions = shared(seed, joints)
    frame.weight[1] = 0.0
    curvature, gradient = reduced(respond(frame, directions, scale))
    slope, at = jacobian(trusted(frame, scale), directions)
    unknowns = len(gradient)
    through = slope[:, :unknowns] + slope[:, unknowns:] @ loose(slope, unknowns)
    expected = slope[:, :unknowns].T @ through
    np.testing.assert_allclose(curvature, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, through.T @ at, atol=1e-6 * np.abs(through.T @ at).max())


def test_joints_and_markers_go_where_the_pose_that_gives_way_takes_them():
    frame, directions = shared(3, 5)
    frame.weight[4] = 0.0
    found, (slope, _) = respond(frame, directions, STILL), jacobian(frame, directions)
    unknowns = found.carried.shape[1]
    give = np.r_[np.eye(unknowns), loose(slope, unknowns)]

    def placed(x):
        body = changed(frame, directions, x[:unknowns])
        position, rotation = dense.forward(body.tree, *dense.moved(body.tree, body.root, body.local, x[unknowns:]))
        return np.r_[position, dense.markers(body.attached, position, rotation)]

    moves = np.moveaxis(dense.jacobian(placed, len(give)) @ give, -1, 0)
    np.testing.assert_allclose(found.carried[0], moves[:, :5], atol=1e-6)
    rotation = dense.forward(frame.tree, frame.root, frame.local)[1][frame.attached.joints]
    np.testing.assert_allclose(found.moved[0, :-1], np.einsum("kba,qkb->qka", rotation, moves[:, 5:]), atol=1e-6)


def test_the_gradient_is_that_of_the_cost_at_the_best_pose():
    frame, directions = shared(7, 4)

    def solved(unknowns):
        trial = changed(frame, directions, unknowns)
        root, local = frame.root[None].copy(), frame.local[None].copy()
        problem_of(trial).solve(root, local, dense.no_pull(4), (STILL, STILL, STILL), 100)
        return respond(trial._replace(root=root[0], local=local[0]), directions, STILL)

    unknowns = COUNT + frame.seen.size
    slope = dense.jacobian(lambda x: solved(x).cost[0], unknowns, step=1e-3)
    gradient = reduced(solved(np.zeros(unknowns)))[1]
    np.testing.assert_allclose(gradient, slope, rtol=0, atol=0.02 * np.abs(slope).max())


def test_frames_that_say_the_same_say_it_as_often():
    frame, directions = shared(8, 3)
    one, three = respond(frame, directions, STILL), respond(frame, directions, STILL, frames=3)
    np.testing.assert_allclose(three.cost, np.full(3, 0.5 * (dense.residuals(frame) ** 2).sum()))
    for once, thrice in zip(reduced(one), reduced(three), strict=True):
        np.testing.assert_allclose(thrice, 3 * once, rtol=1e-9, atol=1e-9 * np.abs(once).max())


@pytest.mark.parametrize("frames", [1, 4])
def test_a_marker_that_is_not_seen_presses_nothing_and_goes_along(frames):
    frame, directions = shared(9, 3)
    frame.weight[2] = 0.0
    found = respond(frame, directions, STILL, frames)
    mine = slice(COUNT + 6, COUNT + 9)
    assert not reduced(found)[0][mine].any()
    assert not found.carried[:, mine].any()
    np.testing.assert_allclose(found.moved[:, mine, 2], np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)

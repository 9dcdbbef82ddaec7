"""Degenerate or invalid input gets a status and a finite pose, never NaN or an exception."""

import numpy as np
import pytest

from mocapfix.model.motion import FrameStatus
from tests.kernels import dense_oracle, random_terms
from tests.kernels.solver_runs import compute_uncertainty, solve_frames_from

FRAMES = 8
ROBUST = np.array([400.0, 25.0])


def draw_body(rng):
    return random_terms.draw_tree(rng, 8)


def draw_single_joint(rng):
    return random_terms.draw_tree(rng, 1)


def draw_body_without_lengths(rng):
    return draw_body(rng)._replace(offsets=np.zeros((8, 3)))


def build_degenerate_frames(rng, tree, markers_each=3):
    """Return a frame's body and pose, and FRAMES frames of degenerate markers; see the comments."""
    joints = np.repeat(np.arange(len(tree.parents)), markers_each)
    frame = dense_oracle.Frame(tree, (), rng.normal(0, 1.0, 3), random_terms.draw_rotations(rng, len(tree.parents)), np.zeros(0))
    offsets = rng.normal(0, 0.15, (len(joints), 3))
    measured = dense_oracle.compute_point_positions(
        joints, offsets, dense_oracle.compute_world(*frame[:1], *frame[2:])
    ) + rng.normal(0, 0.01, (len(joints), 3))
    positions, weight = np.tile(measured, (FRAMES, 1, 1)), np.full((FRAMES, len(joints)), 1e4)
    weight[0], positions[0] = 0.0, np.nan  # no marker
    weight[1, 1:] = 0.0  # one marker
    weight[2, 2:] = 0.0  # two
    positions[3] = [0.3, 1.0, -2.0]  # all at one point
    positions[4, :1] = np.inf  # one of them infinite, NaN, or absurdly far
    positions[5, :1] = np.nan
    positions[6, :1] = -1e12
    positions[7] += 1e5  # all of them a hundred kilometres away
    return frame, random_terms.PointTerm(joints, offsets, positions, weight)


def assert_finite(frame, ends):
    """The ends of all frames are poses with a status."""
    root, local, _, status, _ = ends
    joints, fixed = len(frame.local), ~frame.tree.free
    assert np.isin(
        status, [FrameStatus.CONVERGED, FrameStatus.ITERATION_LIMIT, FrameStatus.EXACT, FrameStatus.UNCONSTRAINED]
    ).all()
    assert np.isfinite(root).all()
    np.testing.assert_allclose(local @ np.swapaxes(local, 2, 3), np.tile(np.eye(3), (FRAMES, joints, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(local[:, fixed], np.tile(frame.local[fixed], (FRAMES, 1, 1, 1)))


@pytest.mark.parametrize("body", [draw_body, draw_single_joint, draw_body_without_lengths])
@pytest.mark.parametrize("scales2", [np.array([np.inf]), ROBUST], ids=["plain", "robust"])
@pytest.mark.parametrize("has_prior", [True, False], ids=["weak prior", "no prior"])
def test_frames_with_degenerate_markers(body, scales2, has_prior):
    frame, points = build_degenerate_frames(np.random.default_rng(4), body(np.random.default_rng(5)))
    joints = len(frame.local)
    terms: dict = {"points": points}
    if has_prior:
        eye = np.tile(np.eye(3), (1, joints, 1, 1))
        terms["pose_prior"] = random_terms.PosePriorTerm(eye, eye / 9)
    frame = frame._replace(terms=random_terms.build_terms(joints, FRAMES, **terms))
    ends = solve_frames_from(frame, scales2, FRAMES, most=12)
    assert_finite(frame, ends)
    root, local, shared, status, _ = ends
    if has_prior:
        assert status[0] in (FrameStatus.CONVERGED, FrameStatus.EXACT)
    else:
        assert status[0] == FrameStatus.UNCONSTRAINED
        np.testing.assert_array_equal(local[0], frame.local)
        np.testing.assert_array_equal(root[0], frame.root)
    ignored = points._replace(weight=points.weight.copy())
    ignored.weight[4:7, :1] = 0.0
    again = solve_frames_from(
        frame._replace(terms=random_terms.build_terms(joints, FRAMES, **terms | {"points": ignored})), scales2, FRAMES, most=12
    )
    for found, expected in zip(ends, again, strict=True):
        np.testing.assert_array_equal(found[4:7], expected[4:7])
    uncertainty = compute_uncertainty(frame, scales2[-1], root, local, shared)
    assert all(np.isfinite(each).all() for each in uncertainty)
    assert all((each >= 0).all() for each in uncertainty)
    assert uncertainty[3][0] == pytest.approx(1e3)  # the variance of an unconstrained unknown


@pytest.mark.parametrize("body", [draw_body, draw_single_joint])
def test_body_without_markers(body):
    frame, points = build_degenerate_frames(np.random.default_rng(6), body(np.random.default_rng(7)), markers_each=0)
    frame = frame._replace(terms=random_terms.build_terms(len(frame.local), FRAMES, points=points))
    ends = solve_frames_from(frame, ROBUST, FRAMES)
    assert_finite(frame, ends)
    assert (ends[3] == FrameStatus.UNCONSTRAINED).all()
    uncertainty = compute_uncertainty(frame, np.inf, *ends[:3])
    assert uncertainty[0].shape == (FRAMES, 0)
    np.testing.assert_allclose(uncertainty[1][:, 0], np.sqrt(1e3))
    assert (
        uncertainty[1] >= np.sqrt(1e3) * (1 - 1e-9)
    ).all()  # growing with the distance from the root, as the bones' directions are unknown
    np.testing.assert_allclose(uncertainty[2][:, frame.tree.free], 1e3)
    np.testing.assert_array_equal(uncertainty[2][:, ~frame.tree.free], 0)


def test_all_markers_of_a_joint_at_its_origin():
    """They determine its position, not its rotation."""
    frame, points = build_degenerate_frames(np.random.default_rng(8), draw_body(np.random.default_rng(9)))
    points.offsets[:] = 0.0
    frame = frame._replace(terms=random_terms.build_terms(8, FRAMES, points=points))
    assert_finite(frame, solve_frames_from(frame, ROBUST, FRAMES))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_start_that_is_not_finite_is_unconstrained(value):
    frame, points = build_degenerate_frames(np.random.default_rng(10), draw_body(np.random.default_rng(11)))
    frame = frame._replace(terms=random_terms.build_terms(8, FRAMES, points=points))
    *_, status, _ = solve_frames_from(frame, ROBUST, FRAMES, start=(np.full(3, value), frame.local, np.zeros(0)))
    assert (status == FrameStatus.UNCONSTRAINED).all()

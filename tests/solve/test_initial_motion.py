"""The start from the frame before: frames with a pose of their own, iterations, and the effect of lost frames."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import initial_motion, kinematics, mean_pose, motion_solver
from mocapfix.solve.initial_motion import start_from_previous
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
MEAN, LIMITS = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), load_joint_limits(BODY.skeleton)


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=4, seconds=2.0)


def started(truth, markers, by):
    """Return the start, and what the solve makes of it"""
    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN, by)
    return start, motion_solver.solve_motion(take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())


def off(truth, motion):
    """Return (T,) metres: the joint that is farthest from the truth"""
    return np.linalg.norm(kinematics.compute_world_poses(truth.subject.skeleton, motion)[0] - truth.joint_positions, axis=-1).max(
        axis=1
    )


@pytest.mark.parametrize(("unseen", "first"), [(0, 0), (7, 7)])
def test_frames_up_to_the_first_well_visible_one_keep_their_pose(truth, unseen, first):
    markers = truth.marker_positions.copy()
    markers[:unseen, 20:] = np.nan  # the other 20 of 41 are there, fewer than half
    own = initial_motion.initialise_motion(Take(markers, truth.labels, truth.rate), truth.subject, BODY, MEAN, "registration")
    start = start_from_previous(own, ~np.isnan(markers[..., 0]))
    np.testing.assert_array_equal(start.root_position[: first + 1], own.root_position[: first + 1])
    np.testing.assert_array_equal(start.local_rotations[: first + 1], own.local_rotations[: first + 1])
    assert np.isnan(start.root_position[first + 1 :]).all()
    assert np.isnan(start.local_rotations[first + 1 :]).all()


def test_chain_starts_at_the_first_frame_if_nothing_is_visible(truth):
    own = initial_motion.initialise_motion(
        Take(truth.marker_positions, truth.labels, truth.rate), truth.subject, BODY, MEAN, "registration"
    )
    assert not np.isnan(start_from_previous(own, np.zeros(truth.missing_mask.shape, bool)).root_position[0]).any()


def test_smooth_motion_takes_fewer_iterations_with_equal_results(truth):
    (_, own), (_, previous) = (started(truth, truth.marker_positions, by) for by in ("registration", "previous"))
    assert previous.iterations.mean() < own.iterations.mean() - 1
    np.testing.assert_allclose(previous.root_position, own.root_position, atol=1e-3)
    assert off(truth, previous).max() < 0.06


def test_frames_without_markers_are_continued(truth):
    markers = truth.marker_positions.copy()
    markers[100:110] = np.nan
    _, motion = started(truth, markers, "previous")
    assert np.isfinite(motion.local_rotations).all()
    assert (motion.status[100:110] == 3).all()
    assert off(truth, motion)[120:].max() < 0.06


def test_turned_body_needs_its_own_start(truth):
    """What a start of every frame's own is for: it does not matter to it what was before."""
    markers, hips = truth.marker_positions.copy(), truth.joint_positions[110:, :1]
    markers[100:110] = np.nan
    markers[110:] = (markers[110:] - hips) * [1.0, -1.0, -1.0] + hips
    previous, own = (started(truth, markers, by)[1].iterations for by in ("previous", "registration"))
    assert previous[110] > 1.5 * own[110]
    assert previous[111:].mean() < own[111:].mean()

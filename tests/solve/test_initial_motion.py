"""First poses at 30 Hz, and the start of the frames between them."""

import numpy as np
import pytest

from mocapfix.lab.sound_takes import solve_motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import initial_motion, kinematics, mean_pose
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.solve.pose_problem import list_posed_frames
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
MEAN, LIMITS = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), load_joint_limits(BODY.skeleton)


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=4, seconds=2.0)


def solve(truth, markers):
    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN, "registration")
    return solve_motion(take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())


def find_largest_errors(truth, motion):
    """Return (T,) metres: the error of the joint that is farthest from the truth."""
    positions = kinematics.compute_world_poses(truth.subject.skeleton, motion)[0]
    return np.linalg.norm(positions - truth.joint_positions, axis=-1).max(axis=1)


@pytest.mark.parametrize(
    ("frames", "rate", "posed"),
    [(10, 120.0, [0, 4, 8, 9]), (9, 120.0, [0, 4, 8]), (4, 30.0, [0, 1, 2, 3]), (3, 24.0, [0, 1, 2]), (1, 240.0, [0])],
)
def test_first_and_last_frame_are_posed_and_others_at_30_hz(frames, rate, posed):
    assert list_posed_frames(frames, rate).tolist() == posed


def test_frames_between_posed_ones_take_fewer_iterations(truth):
    motion = solve(truth, truth.marker_positions)
    posed = list_posed_frames(motion.frame_count, truth.rate)
    between = np.delete(np.arange(motion.frame_count), posed)
    assert motion.iterations[between].mean() < motion.iterations[posed].mean() - 1
    assert find_largest_errors(truth, motion).max() < 0.06


def test_frame_starts_from_its_own_pose_where_that_is_nearer(truth):
    """The body is turned upside down between two posed frames, far from the interpolation of these."""
    markers, hips = truth.marker_positions.copy(), truth.joint_positions[:, :1]
    first = list_posed_frames(len(markers), truth.rate)[20] + 1
    turned = slice(first, first + 2)
    markers[turned] = (markers[turned] - hips[turned]) * [1.0, -1.0, -1.0] + hips[turned]
    motion = solve(truth, markers)
    rotation = motion.local_rotations[turned, 0] @ np.swapaxes(truth.motion.local_rotations[turned, 0], 1, 2)
    np.testing.assert_allclose(rotation[:, 1, 1], -1.0, atol=0.1)

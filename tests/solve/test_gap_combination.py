"""The combination of the motion prior's prediction with another estimate."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.solve import motion_prior
from mocapfix.solve.motion_prior import CONTEXT_DISTANCES_S, GapContext, GapPrediction

RATE_HZ = 60.0


def test_crop_keeps_what_the_network_is_given():
    root = np.arange(300)[:, None] * np.array([1.0, 0, 0])
    context = GapContext(root, np.tile(np.eye(3), (300, 31, 1, 1)), np.ones((300, 31), bool), 140, 170, RATE_HZ)
    cropped = context.crop()
    assert cropped.first > RATE_HZ * CONTEXT_DISTANCES_S[-1]
    assert len(cropped.root_position) - cropped.last - 1 > RATE_HZ * CONTEXT_DISTANCES_S[-1]
    assert len(cropped.root_position) < 180
    np.testing.assert_array_equal(cropped.root_position[cropped.frames, 0], np.arange(140, 171))


def predict(angle, variance):
    rotations = Rotation.from_rotvec([[0, angle, 0]]).as_matrix()[None]
    return GapPrediction(rotations, np.array([[variance]]), np.zeros((1, 3)), np.zeros(1))


def test_the_more_certain_estimate_counts_more():
    angles = []
    for predicted_variance in (1e-6, 0.02, 10.0, np.inf):
        rotations, variance = motion_prior.combine_rotations(
            np.eye(3)[None, None], np.array([[0.04]]), predict(0.5, predicted_variance)
        )
        angles.append(float(Rotation.from_matrix(rotations[0, 0]).magnitude()))
        assert 0 <= variance[0, 0] <= 0.042
    np.testing.assert_allclose(angles[0], 0.5, atol=1e-3)
    np.testing.assert_allclose(angles[1], 0.25, atol=1e-9)
    assert angles[2] < 0.01
    assert angles[3] == 0


def test_exact_estimates_stay():
    rotations, variance = motion_prior.combine_rotations(np.eye(3)[None, None], np.zeros((1, 1)), predict(0.5, 0.0))
    np.testing.assert_array_equal(rotations[0, 0], np.eye(3))
    assert variance[0, 0] == 0

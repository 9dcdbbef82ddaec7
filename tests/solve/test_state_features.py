"""The features of the state of a body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.solve import occluded_joints

RATE = 60.0


def test_features_are_those_of_the_moving_body():
    t = np.arange(120) / RATE
    local = np.tile(np.eye(3), (120, 3, 1, 1))
    local[:, 0] = Rotation.from_euler("y", 0.5 * t[:, None]).as_matrix()
    local[:, 2] = Rotation.from_euler("x", 0.8 * t[:, None]).as_matrix()
    root = np.stack([0 * t, 0.9 + 0.1 * t, 0 * t], 1) + 0.7 * np.stack([np.cos(0.5 * t), 0 * t, -np.sin(0.5 * t)], 1)
    frames = np.arange(10, 110, 7)
    features = occluded_joints.compute_joint_state_features(root, local, np.array([2]), frames, RATE)
    np.testing.assert_allclose(features[:, :9] * np.sqrt(2), local[frames, 2].reshape(-1, 9))
    np.testing.assert_allclose(
        features[:, 9:12] * occluded_joints.ANGULAR_VELOCITY_UNIT_RAD_S, np.tile([0.8, 0, 0], (15, 1)), atol=1e-9
    )
    np.testing.assert_allclose(features[:, 12:15] * occluded_joints.ROOT_UP_UNIT, np.tile([0, 1, 0], (15, 1)), atol=1e-12)
    np.testing.assert_allclose(features[:, 15] * occluded_joints.ROOT_HEIGHT_UNIT_M, root[frames, 1])
    np.testing.assert_allclose(
        features[:, 16:19] * occluded_joints.ROOT_SPEED_UNIT_M_S, np.tile([0, 0.1, -0.35], (15, 1)), atol=1e-3
    )  # 0.7 m, 0.5 rad/s
    np.testing.assert_allclose(features[:, 19:] * occluded_joints.ROOT_SPIN_UNIT_RAD_S, np.tile([0, 0.5, 0], (15, 1)), atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2])
def test_single_frame_has_features(frames):
    local = np.tile(np.eye(3), (frames, 2, 1, 1))
    features = occluded_joints.compute_joint_state_features(np.zeros((frames, 3)), local, np.array([1]), np.arange(frames), RATE)
    assert np.isfinite(features).all()

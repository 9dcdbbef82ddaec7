"""Predictions of a pose model in which both arms move together."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.pose_prior import GaussianModel
from mocapfix.solve.prior_conditioner import PriorConditioner

BODY = load_cmu31_body()
NAMES, JOINTS = BODY.skeleton.names, len(BODY.skeleton.names)
LEFT, RIGHT = NAMES.index("LeftArm"), NAMES.index("RightArm")
OBSERVED = np.array([j for j in np.flatnonzero(BODY.free_joints)[1:] if j != LEFT])


def mirrors():
    """Return a model in which the left arm turns about x as the right one does"""
    components = np.zeros((1, JOINTS, 3))
    components[0, [LEFT, RIGHT], 0] = 1.0
    sigma = np.full(JOINTS, 0.02)
    return GaussianModel(NAMES, np.tile(np.eye(3), (JOINTS, 1, 1)), sigma, np.zeros((JOINTS, 3)), components, 0.02)


def poses(angles):
    """Return local rotations of a person whose right arm is rotated about x by these angles."""
    local = np.tile(np.eye(3), (len(angles), JOINTS, 1, 1))
    local[:, RIGHT] = Rotation.from_euler("x", angles[:, None]).as_matrix()
    return local


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_occluded_arm_follows_the_observed_one(sign):
    angles, frames = np.linspace(-1, 1, 9), np.array([1, 4, 8])
    local = poses(angles)
    near = np.tile([0.0, 0.0, 0.0, sign], (3, 1))
    turns = PriorConditioner(mirrors, 1.0).predict_rotations(local, OBSERVED, np.array([LEFT]), frames, near)
    half = angles[frames] / 2
    expected = 2 * sign * np.stack([np.sin(half), 0 * half, 0 * half, np.cos(half)], axis=1)
    np.testing.assert_allclose(turns, expected, atol=0.02)


def test_occluded_joints_are_ignored_and_input_is_not_modified():
    local = poses(np.full(4, 0.5))
    elsewhere = local.copy()
    elsewhere[:, LEFT] = Rotation.from_euler("y", 1.0).as_matrix()
    was = elsewhere.copy()
    arguments = (OBSERVED, np.array([LEFT]), np.arange(4), np.ones((4, 4)))
    people = PriorConditioner(mirrors, 1.0)
    np.testing.assert_allclose(
        people.predict_rotations(elsewhere, *arguments), people.predict_rotations(local, *arguments), atol=1e-3
    )
    np.testing.assert_array_equal(elsewhere, was)

"""Information of two segments on their common joint is combined once."""

import numpy as np
import pytest

from mocapfix.kernels.belief_propagation import JointSegments, SegmentTree, propagate_segment_frames
from tests.kernels import random_terms

SD, EYES = 0.005, np.tile(np.eye(3), (2, 1, 1))
ORIGIN = np.array([[0, 0, 0], [0.3, 0, 0]])  # of the segments, each in its parent's axes
# eight markers each, symmetric about the joint, so that its variance is the same along all axes
CORNERS = 0.1 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
PLACE = np.concatenate([CORNERS + ORIGIN[1], CORNERS])
MEETINGS = JointSegments(np.array([0, 1, 3]), np.array([0, 0, 1]), np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 0]]))


def segments(joint_information=1.0):
    return SegmentTree(
        np.array([0, 0]), ORIGIN, EYES, joint_information * EYES, np.array([0, 8, 16]), PLACE, np.full(16, SD**-2), EYES,
        PLACE + ORIGIN[np.repeat([0, 1], 8)],
    )  # fmt: skip


def drawn_markers(rng, frames):
    """Return joints (T, 2, 3) and markers (T, 16, 3) of the two, each turned at random"""
    upper, lower, root = (
        random_terms.draw_rotations(rng, frames),
        random_terms.draw_rotations(rng, frames),
        rng.normal(size=(frames, 3)),
    )
    joint = root + upper @ ORIGIN[1]
    markers = np.concatenate(
        [root[:, None] + PLACE[:8] @ upper.transpose(0, 2, 1), joint[:, None] + CORNERS @ lower.transpose(0, 2, 1)], 1
    )
    return np.stack([root, joint], 1), markers


def fit(markers, joint_information=1.0):
    """Return positions (T, 2, 3) and variances (T, 2)"""
    position, variance = np.empty((len(markers), 2, 3)), np.empty((len(markers), 2))
    propagate_segment_frames(
        segments(joint_information), MEETINGS, markers, position, variance, np.empty(markers.shape[:2]), 0, len(markers)
    )
    return position, variance


@pytest.mark.parametrize(("lost", "share"), [(slice(0, 0), 1 / 16), (slice(0, 8), 1 / 8), (slice(8, 16), 1 / 8)])
def test_joint_variance_uses_all_markers_once(lost, share):
    rng = np.random.default_rng(1)
    joints, markers = drawn_markers(rng, 4000)
    markers += rng.normal(0, SD, markers.shape)
    markers[:, lost] = np.nan
    position, variance = fit(markers)
    np.testing.assert_allclose(variance[:, 1], share * SD**2, rtol=0.02)
    np.testing.assert_allclose(np.var((position - joints)[:, 1]), share * SD**2, rtol=0.05)


def test_missing_root_follows_from_the_child_and_the_joint():
    joints, markers = drawn_markers(np.random.default_rng(2), 200)
    turn = markers[:, 8:] - joints[:, 1:]
    rotation = np.einsum("tka,kb->tab", turn, CORNERS) / (8 * 0.01)
    markers[:, :8] = np.nan
    position, variance = fit(markers, joint_information=1e4)
    np.testing.assert_allclose(position[:, 0], joints[:, 1] - rotation @ ORIGIN[1], atol=1e-6)
    # the root's rotation variance is the child's, of 8 markers at a lever of 0.14 m about each axis, plus the joint's,
    # (0.01 rad)^2; two of three axes move the root
    rotation_variance = 1 / (8 * 0.02 / SD**2) + 1e-4
    np.testing.assert_allclose(variance[:, 0], SD**2 / 8 + 2 / 3 * 0.09 * rotation_variance, rtol=0.02)

"""Heel and toes of a foot: its rearmost and foremost markers, and points of the body where it has none."""

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.contacts.foot_points import build_foot_points
from mocapfix.solve import kinematics

TAKE = synthetic.compose_take(seed=0, seconds=1.0)
SUBJECT = TAKE.subject
_, BODY_MARKERS = kinematics.compute_joint_and_marker_positions(SUBJECT, TAKE.motion)


def build(markers: np.ndarray):
    """Return the points of both feet."""
    return build_foot_points(SUBJECT, TAKE.motion, markers, BODY_MARKERS)


@pytest.mark.parametrize(("side", "heel", "toe"), [("left", "LHEE", "LTOE"), ("right", "RHEE", "RTOE")])
def test_markers_of_heel_and_toes_are_used(side, heel, toe):
    points = build(TAKE.marker_positions)[side]
    np.testing.assert_array_equal(points.heel, TAKE.marker_positions[:, SUBJECT.labels.index(heel)])
    distance = np.linalg.norm(points.toe - TAKE.marker_positions[:, SUBJECT.labels.index(toe)], axis=1)
    other = np.linalg.norm(points.toe - TAKE.marker_positions[:, SUBJECT.labels.index(toe[0] + "MT5")], axis=1)
    assert min(distance.max(), other.max()) == 0


def test_a_marker_that_is_missing_for_a_while_is_where_the_body_carries_it():
    markers = TAKE.marker_positions.copy()
    heel = SUBJECT.labels.index("LHEE")
    markers[40:50, heel] = np.nan
    points = build(markers)["left"]
    np.testing.assert_array_equal(points.heel[40:50], BODY_MARKERS[40:50, heel])


def test_without_markers_the_body_shows_heel_and_toes():
    points = build(np.full(TAKE.marker_positions.shape, np.nan))
    for side in ("left", "right"):
        heel, toe = points[side]
        assert np.isfinite(heel).all()
        assert np.isfinite(toe).all()
        ankle = TAKE.joint_positions[:, SUBJECT.skeleton.find_joint(f"{side.capitalize()}Foot")]
        assert (heel[:, 1] < ankle[:, 1]).all()
        assert (np.linalg.norm(toe - heel, axis=1) > 0.15).all()

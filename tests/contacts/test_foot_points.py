"""Heel and toes of a foot: its rearmost and foremost markers, and points of the body where it has none."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.contacts.gait_events import build_foot_points
from mocapfix.solve import kinematics
from mocapfix.synthetic import compose_take

TAKE = compose_take(seed=0, seconds=1.0)
SUBJECT = TAKE.subject
_, BODY_MARKERS = kinematics.compute_joint_and_marker_positions(SUBJECT, TAKE.motion)


def build(markers: np.ndarray):
    """Return the points of both feet, whose joints no marker shows."""
    return build_foot_points(SUBJECT, TAKE.motion, markers, BODY_MARKERS, np.zeros((len(markers), 4), bool))


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
    assert np.flatnonzero(~points.is_seen[:, 0]).tolist() == list(range(40, 50))
    assert points.is_seen[:, 1].all()


def test_without_markers_the_body_shows_heel_and_toes():
    points = build(np.full(TAKE.marker_positions.shape, np.nan))
    for side in ("left", "right"):
        heel, toe = points[side].paths
        assert np.isfinite(heel).all()
        assert np.isfinite(toe).all()
        ankle = TAKE.joint_positions[:, SUBJECT.skeleton.find_joint(f"{side.capitalize()}Foot")]
        assert (heel[:, 1] < ankle[:, 1]).all()
        assert (np.linalg.norm(toe - heel, axis=1) > 0.15).all()


def test_points_without_markers_are_seen_where_the_joints_are_known():
    markers, is_known = np.full(TAKE.marker_positions.shape, np.nan), np.zeros((len(TAKE.marker_positions), 4), bool)
    is_known[20:, 0] = is_known[30:, 1] = True
    points = build_foot_points(SUBJECT, TAKE.motion, markers, BODY_MARKERS, is_known)
    np.testing.assert_array_equal(points["left"].is_seen, is_known[:, :2])
    assert not points["right"].is_seen.any()


def test_a_marker_behind_the_toe_base_does_not_stand_for_the_toes():
    toe_base = SUBJECT.skeleton.find_joint("LeftToeBase")
    bone = SUBJECT.skeleton.offsets[toe_base]
    behind = np.flatnonzero(SUBJECT.joints == SUBJECT.skeleton.find_joint("LeftFoot"))
    offsets = SUBJECT.marker_offsets.copy()
    offsets[behind] = 0.85 * bone
    markers = np.full(TAKE.marker_positions.shape, np.nan)
    markers[:, behind] = 7.0
    moved = replace(SUBJECT, marker_offsets=offsets)
    points = build_foot_points(moved, TAKE.motion, markers, BODY_MARKERS, np.zeros((len(markers), 4), bool))["left"]
    assert not np.any(points.toe == 7.0)

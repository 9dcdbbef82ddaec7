"""The checks of a learned marker set."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.stats.marker_distances import measure_distance_spread
from mocapfix.subject.learning import (
    LearnedBody,
    count_segments_between,
    describe_implausible_body,
    describe_incomplete_location,
    find_contradicted_markers,
    find_impossible_joint,
    measure_position_spread,
)
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

CMU, SKELETON = load_marker_set("cmu41"), load_cmu31_body().skeleton
LIMITS = load_joint_limits(SKELETON)


def joint(name: str) -> int:
    return SKELETON.find_joint(name)


@pytest.fixture(scope="module")
def learned() -> LearnedBody:
    truth = compose_take(seed=4, seconds=6.0, rate=25.0)
    rotations = kinematics.compute_world_poses(truth.subject.skeleton, truth.motion)[1]
    markers = truth.marker_positions
    return LearnedBody(CMU, 0.003, 1.0, rotations, measure_distance_spread(markers), measure_position_spread(markers))


def test_a_correct_body_is_plausible(learned):
    assert describe_implausible_body(learned, LIMITS, from_positions=True) == ""


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"size_ratio": 0.6}, "60% of the size"),
        ({"mean_residual_m": 0.02}, "20 mm from its markers"),
        ({"distance_spread": np.full((41, 41), 0.001)}, "moves too little"),
    ],
)
def test_an_implausible_body_is_described(learned, changed, problem):
    assert problem in describe_implausible_body(replace(learned, **changed), LIMITS, from_positions=True)


def test_a_child_is_plausible_if_words_locate_it(learned):
    assert describe_implausible_body(replace(learned, size_ratio=0.6), LIMITS, from_positions=False) == ""


def test_thigh_markers_on_an_arm_are_a_contradiction(learned):
    joints = CMU.joints.copy()
    wrong = [CMU.labels.index("RTHI"), CMU.labels.index("RKNE")]
    joints[wrong[0]] = joint("RightForeArm")
    spread = learned.distance_spread.copy()
    spread[wrong[0], wrong[1]] = spread[wrong[1], wrong[0]] = 0.002
    found = find_contradicted_markers(count_segments_between(joints), spread, learned.position_spread)
    assert np.flatnonzero(found).tolist() == sorted(wrong)
    right = find_contradicted_markers(count_segments_between(CMU.joints), spread, learned.position_spread)
    assert not right.any()


def test_segments_between_two_joints_are_counted():
    names = ("Hips", "Head", "LeftArm", "RightForeArm", "LeftUpLeg", "LeftFoot")
    distance = count_segments_between(np.array([joint(name) for name in names]))
    assert (distance == distance.T).all()
    assert distance[0].tolist() == [0, 2, 3, 4, 1, 3]
    assert distance[1, 2] == 3  # over thorax and shoulder


def test_a_knee_that_bends_forwards_is_found(learned):
    assert find_impossible_joint(CMU.joints, learned.joint_rotations, LIMITS) == ""
    turned = learned.joint_rotations.copy()
    thigh, shank = joint("LeftUpLeg"), joint("LeftLeg")
    bend = np.array([[1, 0, 0], [0, np.cos(-1.5), -np.sin(-1.5)], [0, np.sin(-1.5), np.cos(-1.5)]])
    turned[:, shank] = turned[:, thigh] @ bend @ LIMITS.mean_rotations[shank]
    assert find_impossible_joint(CMU.joints, turned, LIMITS) == "LeftLeg"


def test_a_foot_that_is_turned_round_is_found(learned):
    turned, foot = learned.joint_rotations.copy(), joint("RightFoot")
    turned[:, foot] = turned[:, joint("RightLeg")] @ np.diag([-1.0, 1.0, -1.0]) @ LIMITS.mean_rotations[foot]
    assert find_impossible_joint(CMU.joints, turned, LIMITS) == "RightFoot"


def test_a_body_located_by_positions_needs_all_its_segments():
    assert describe_incomplete_location(CMU.joints, 41) == ""
    assert describe_incomplete_location(CMU.joints, 60) == "explains only 41 of 60 markers"
    without_head = CMU.joints[CMU.joints != joint("Head")]
    assert describe_incomplete_location(without_head, len(without_head)) == "has too few markers on Head"

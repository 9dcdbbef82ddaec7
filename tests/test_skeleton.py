from dataclasses import replace

import numpy as np
import pytest

from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
LEAVES = {"LeftToeBase", "RightToeBase", "Head", "LeftHandIndex1", "LThumb", "RightHandIndex1", "RThumb"}


def other_side(name):
    for left, right in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
        if name.startswith(left):
            return name.replace(left, right)
        if name.startswith(right):
            return name.replace(right, left)
    return name


def test_it_has_31_joints_and_7_end_sites():
    ended = {name for name, end in zip(SKELETON.names, SKELETON.ends, strict=True) if not np.isnan(end).any()}
    assert len(SKELETON.names) == len(set(SKELETON.names)) == 31
    assert ended == LEAVES


def test_parents_come_before_children_and_only_leaves_have_none():
    assert SKELETON.names[0] == "Hips"
    assert SKELETON.parents[0] == -1
    assert (SKELETON.parents[1:] < np.arange(1, 31)).all()
    assert (SKELETON.parents[1:] >= 0).all()
    assert {SKELETON.names[j] for j in set(range(31)) - set(SKELETON.parents)} == LEAVES


@pytest.mark.parametrize("name", SKELETON.names)
def test_left_and_right_are_alike(name):
    one, other = SKELETON.find_joint(name), SKELETON.find_joint(other_side(name))
    mirrored = np.array([-1, 1, 1])
    np.testing.assert_array_equal(SKELETON.offsets[one], SKELETON.offsets[other] * mirrored)
    np.testing.assert_array_equal(SKELETON.ends[one], SKELETON.ends[other] * mirrored)
    if SKELETON.parents[one] >= 0:
        assert SKELETON.names[SKELETON.parents[other]] == other_side(SKELETON.names[SKELETON.parents[one]])


def test_the_lengths_are_an_adults():
    length = dict(zip(SKELETON.names, np.linalg.norm(SKELETON.offsets, axis=1), strict=True))
    assert length["LeftLeg"] + length["LeftFoot"] == pytest.approx(0.86, abs=0.005)  # thigh and shin, as the file says
    head = sum(SKELETON.offsets[SKELETON.find_joint(name), 1] for name in ("Spine", "Spine1", "Neck", "Neck1", "Head"))
    assert 0.5 < head < 0.65  # from the hips to the skull's base


def test_a_group_scales_both_sides_and_no_joint_twice():
    joints = [j for group in load_cmu31_body().bone_groups.values() for j in group]
    assert len(joints) == len(set(joints))
    for group in load_cmu31_body().bone_groups.values():
        names = {SKELETON.names[j] for j in group}
        assert {other_side(name) for name in names} == names


def test_what_no_marker_turns_is_not_free():
    fixed = {name for name, free in zip(SKELETON.names, load_cmu31_body().free_joints, strict=True) if not free}
    assert {"LHipJoint", "RHipJoint"} | LEAVES - {"Head"} <= fixed
    assert fixed.isdisjoint({"Hips", "Spine1", "Head", "LeftArm", "LeftUpLeg", "RightFoot"})


def test_at_rest_each_joint_lies_its_offset_from_its_parent_and_the_root_at_its_own():
    moved = replace(SKELETON, offsets=SKELETON.offsets + [0.1, 0.0, 0.0])
    places, hung = moved.rest_positions, moved.parents >= 0
    np.testing.assert_allclose(places[hung] - places[moved.parents[hung]], moved.offsets[hung], atol=1e-12)
    np.testing.assert_array_equal(places[0], moved.offsets[0])
    assert (moved.total_length_m, replace(moved, offsets=2 * moved.offsets).total_length_m) == pytest.approx(
        (moved.total_length_m, 2 * moved.total_length_m)
    )

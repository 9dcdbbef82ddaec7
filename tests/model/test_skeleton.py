"""The 31-joint skeleton, and the shape components of the body model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.lab.training_poses import mirror_joint_name
from mocapfix.model.skeleton import (
    Skeleton,
    compute_local_rotations,
    find_ancestor,
    find_common_joint,
    is_below,
    list_path,
    load_cmu31_body,
    load_cmu31_skeleton,
    load_shape_components,
    restrict_body,
)

BODY = load_cmu31_body()
SKELETON, SHAPES = BODY.skeleton, BODY.shape_components
LEAVES = {"LeftToeBase", "RightToeBase", "Head", "LeftHandIndex1", "LThumb", "RightHandIndex1", "RThumb"}
MIRROR = np.array([-1, 1, 1])


def test_skeleton_has_31_joints_and_7_end_sites():
    with_end_site = {name for name, end in zip(SKELETON.names, SKELETON.ends, strict=True) if not np.isnan(end).any()}
    assert len(SKELETON.names) == len(set(SKELETON.names)) == 31
    assert with_end_site == LEAVES


def test_parents_precede_children():
    assert SKELETON.names[0] == "Hips"
    assert SKELETON.parents[0] == -1
    assert (SKELETON.parents[1:] < np.arange(1, 31)).all()
    assert (SKELETON.parents[1:] >= 0).all()
    assert {SKELETON.names[joint] for joint in set(range(31)) - set(SKELETON.parents)} == LEAVES


@pytest.mark.parametrize("name", SKELETON.names)
def test_skeleton_is_symmetric(name: str):
    joint, mirrored_joint = SKELETON.find_joint(name), SKELETON.find_joint(mirror_joint_name(name))
    np.testing.assert_array_equal(SKELETON.offsets[joint], SKELETON.offsets[mirrored_joint] * MIRROR)
    np.testing.assert_array_equal(SKELETON.ends[joint], SKELETON.ends[mirrored_joint] * MIRROR)
    if SKELETON.parents[joint] >= 0:
        parent = SKELETON.names[SKELETON.parents[joint]]
        assert SKELETON.names[SKELETON.parents[mirrored_joint]] == mirror_joint_name(parent)


def test_bone_lengths_are_those_of_an_adult():
    length_m = dict(zip(SKELETON.names, np.linalg.norm(SKELETON.offsets, axis=1), strict=True))
    assert length_m["LeftLeg"] + length_m["LeftFoot"] == pytest.approx(0.86, abs=0.005)  # thigh and shin
    trunk = ("Spine", "Spine1", "Neck", "Neck1", "Head")
    assert 0.5 < sum(SKELETON.offsets[SKELETON.find_joint(name), 1] for name in trunk) < 0.65  # from the hips to the head


def test_bone_groups_are_symmetric_and_disjoint():
    joints = [joint for group in BODY.bone_groups.values() for joint in group]
    assert len(joints) == len(set(joints))
    for group in BODY.bone_groups.values():
        names = {SKELETON.names[joint] for joint in group}
        assert {mirror_joint_name(name) for name in names} == names


def test_joints_without_markers_are_not_free():
    fixed = {name for name, is_free in zip(SKELETON.names, BODY.free_joints, strict=True) if not is_free}
    assert {"LHipJoint", "RHipJoint"} | LEAVES - {"Head"} <= fixed
    assert fixed.isdisjoint({"Hips", "Spine1", "Head", "LeftArm", "LeftUpLeg", "RightFoot"})


def test_rest_positions_accumulate_offsets():
    displaced = replace(SKELETON, offsets=SKELETON.offsets + [0.1, 0.0, 0.0])
    positions, has_parent = displaced.rest_positions, displaced.parents >= 0
    relative = positions[has_parent] - positions[displaced.parents[has_parent]]
    np.testing.assert_allclose(relative, displaced.offsets[has_parent], atol=1e-12)
    np.testing.assert_array_equal(positions[0], displaced.offsets[0])


def test_total_length_scales_with_offsets():
    doubled = replace(SKELETON, offsets=2 * SKELETON.offsets)
    assert doubled.total_length_m == pytest.approx(2 * SKELETON.total_length_m)


def test_shape_components_are_read_by_joint(tmp_path: Path):
    path = tmp_path / "two.yaml"
    path.write_text("components:\n- {b: [1, 2.5, -3]}\n- {a: [0, 0, 0.1], c: [4, 5, 6]}\n", encoding="utf-8")
    expected = [[[0, 0, 0], [1, 2.5, -3], [0, 0, 0]], [[0, 0, 0.1], [0, 0, 0], [4, 5, 6]]]
    np.testing.assert_array_equal(load_shape_components(path, ("a", "b", "c")), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bones: []", r"components must be a list"),
        ("components: 3", r"components must be a list"),
        ("components:\n- {a: [0, 0, 0]}\n- {tail: [0, 0, 0]}", r"components\.1 must give joints"),
        ("components:\n- {a: [0, 0]}", r"components\.0 must give joints"),
        ("components:\n- {a: [0, 0, long]}", r"components\.0 must give joints"),
        ("components:\n- {a: 0.1}", r"components\.0 must give joints"),
        ("components:\n- a", r"components\.0 must give joints"),
    ],
)
def test_invalid_shape_component_is_named(tmp_path: Path, text: str, message: str):
    path = tmp_path / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError, match=rf"wrong\.yaml: {message}"):
        load_shape_components(path, ("a", "b", "c"))


def test_shape_components_are_orthogonal_and_decrease():
    norms_m = np.sqrt((SHAPES**2).sum(axis=(1, 2)))
    assert len(SHAPES) == 10
    assert (np.diff(norms_m) <= 0).all()
    assert norms_m[0] < 0.04  # over all joints together
    flat = SHAPES.reshape(10, -1)
    np.testing.assert_allclose(flat @ flat.T, np.diag(norms_m**2), atol=1e-6)


def test_shape_components_do_not_change_the_size():
    offsets = load_cmu31_skeleton().offsets
    size_change = np.einsum("pja,ja->p", SHAPES, offsets) / (offsets**2).sum()
    np.testing.assert_allclose(size_change, 0, atol=1e-4)


def test_shape_components_are_symmetric_or_antisymmetric():
    mirrored_joints = [SKELETON.names.index(mirror_joint_name(name)) for name in SKELETON.names]
    mirrored = SHAPES[:, mirrored_joints] * MIRROR
    sign = np.sign((mirrored * SHAPES).sum(axis=(1, 2)))
    np.testing.assert_allclose(mirrored, sign[:, None, None] * SHAPES, atol=2e-5)


LEG = ("LeftUpLeg", "LeftLeg", "LeftFoot")
LEG_JOINTS = {"LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"}
PELVIS_JOINTS = {"Hips", "LHipJoint", "RHipJoint", "LowerBack", "RightUpLeg"}
ARM_JOINTS = {"LeftArm", "LeftForeArm", "LeftHand", "LeftFingerBase", "LeftHandIndex1", "LThumb"}


@pytest.mark.parametrize(
    ("marked", "free", "solved"),
    [
        (("Hips", *LEG), {"Hips", *LEG}, PELVIS_JOINTS | LEG_JOINTS),
        (("Hips", "LeftFoot"), {"Hips", *LEG}, PELVIS_JOINTS | LEG_JOINTS),  # the segments between them
        (("Hips", *LEG, "LeftToeBase"), {"Hips", *LEG}, PELVIS_JOINTS | LEG_JOINTS),
        (LEG, {"Hips", "LeftLeg", "LeftFoot"}, LEG_JOINTS),
        (
            ("Spine1", "LeftArm", "LeftForeArm", "LeftHand"),
            {"Hips", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"},
            {"Spine1", "Neck", "LeftShoulder", "RightShoulder"} | ARM_JOINTS,
        ),
        (("Spine1", "LeftArm"), {"Hips", "LeftShoulder", "LeftArm"},
         {"Spine1", "Neck", "LeftShoulder", "RightShoulder", "LeftArm", "LeftForeArm"}),
    ],
)  # fmt: skip
def test_part_of_a_body_is_what_lies_between_its_markers(marked, free, solved):
    part = restrict_body(BODY, [SKELETON.find_joint(name) for name in marked])
    assert {SKELETON.names[j] for j in np.flatnonzero(part.free_joints)} == free
    assert {SKELETON.names[j] for j in np.flatnonzero(part.solved_joints)} == solved


def test_whole_body_keeps_its_free_joints_and_is_solved_as_far_as_it_has_markers():
    marked = [SKELETON.find_joint(name) for name in ("Hips", "Spine1", "Head", "LeftArm", "RightForeArm", "LeftFoot", "RightLeg")]
    part = restrict_body(BODY, marked)
    np.testing.assert_array_equal(part.free_joints, BODY.free_joints)
    unsolved = {SKELETON.names[j] for j in np.flatnonzero(~part.solved_joints)}
    assert unsolved == {"LeftHand", "RightToeBase"} | {
        side + name for side in ("Left", "Right") for name in ("FingerBase", "HandIndex1")
    } | {"LThumb", "RThumb"}  # fmt: skip
    assert BODY.solved_joints.all()


def test_body_without_markers_is_not_restricted():
    assert restrict_body(BODY, ()) is BODY


def test_joints_turn_about_any_axis_without_limits_unless_they_are_hinges():
    assert np.isnan(SKELETON.hinge_axes).all()
    assert np.isinf(SKELETON.limits_rad).all()
    axes, limits_rad = SKELETON.hinge_axes.copy(), SKELETON.limits_rad.copy()
    knee = SKELETON.find_joint("LeftLeg")
    axes[knee], limits_rad[knee] = [1, 0, 0], [[0, 2.5], [0, 0], [0, 0]]
    robot = replace(SKELETON, hinge_axes=axes, limits_rad=limits_rad)
    assert np.flatnonzero(np.isfinite(robot.hinge_axes).all(1)).tolist() == [knee]
    assert robot.limits_rad[knee, 0].tolist() == [0, 2.5]


def test_rest_pose_composes_rest_rotations():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about Z
    arm = Skeleton(
        ("upper arm", "forearm"),
        np.array([-1, 0]),
        np.array([[1.0, 2, 3], [0, 0.5, 0]]),
        np.zeros((2, 3)),
        np.stack([turn, turn]),
    )
    positions, rotations = arm.compute_rest_pose()
    np.testing.assert_allclose(positions, [[1, 2, 3], [0.5, 2, 3]])
    np.testing.assert_allclose(rotations, [turn, turn @ turn])
    np.testing.assert_array_equal(arm.is_leaf, [False, True])
    np.testing.assert_allclose(compute_local_rotations(rotations, arm.parents), arm.rest_rotations)


def test_paths_and_common_joints_of_a_tree():
    parents = np.array([-1, 0, 1, 1, 3, -1])
    assert list_path(4, 0, parents) == [1, 3, 4]
    assert list_path(2, -1, parents) == [0, 1, 2]
    assert find_common_joint(parents, (2, 4)) == 1
    assert find_common_joint(parents, (3, 4)) == 3
    assert find_common_joint(parents, (2, 5)) == -1
    assert is_below(4, 1, parents)
    assert not is_below(1, 1, parents)
    assert find_ancestor(4, parents, np.array([True, False, True, False, True, True])) == 0

"""Tails of the bones that the add-on makes."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from tests.addon.addon_modules import load_addon_module

rest_bones, solved_take = (load_addon_module(name) for name in ("rest_bones", "solved_take"))


def build_body(names, parents, offsets, ends=None):
    offsets = np.array(offsets, float)
    ends = np.full(offsets.shape, np.nan) if ends is None else np.array(ends, float)
    root, rotations = np.zeros((1, 3)), np.zeros((1, len(names), 4))
    return solved_take.SkeletonMotion(
        tuple(names), np.array(parents), offsets, ends, root, rotations, 30.0, np.ones(len(names), bool)
    )


def test_bone_points_to_its_only_child_and_last_bones_to_their_ends():
    body = build_body("ab", [-1, 0], [[0, 0, 0], [0, 0, 0.4]], [[np.nan] * 3, [0, -0.1, 0]])
    np.testing.assert_allclose(rest_bones.compute_tail_offsets(body), [[0, 0, 0.4], [0, -0.1, 0]])


def test_last_bone_without_an_end_continues_its_parent():
    body = build_body("ab", [-1, 0], [[0, 0, 0], [0, 0, 0.4]])
    np.testing.assert_allclose(rest_bones.compute_tail_offsets(body)[1], [0, 0, 0.4 * rest_bones.END_LENGTH_SHARE])


def test_bone_with_children_on_all_sides_points_to_the_one_that_carries_most():
    body = build_body(
        "abcdef", [-1, 0, 0, 0, 3, 4], [[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0], [0, 0, 0.1], [0, 0, 0.1], [0, 0, 0.1]]
    )
    np.testing.assert_allclose(rest_bones.compute_tail_offsets(body)[0], [0, 0, 0.1])


def test_joint_at_the_place_of_its_parent_is_skipped_and_has_the_same_direction():
    body = build_body("abcd", [-1, 0, 1, 0], [[0, 0, 0], [0, 0, 0], [0, 0, 0.2], [0, -0.3, 0]])
    tails = rest_bones.compute_tail_offsets(body)
    np.testing.assert_allclose(tails[1], [0, 0, 0.2])
    assert np.linalg.norm(tails[0]) < np.linalg.norm(tails[1])


def test_single_joint_has_a_bone():
    assert np.linalg.norm(rest_bones.compute_tail_offsets(build_body("a", [-1], [[0, 0, 0]]))) > 0.01


@pytest.fixture(scope="module")
def human():
    skeleton = load_cmu31_body().skeleton
    convert = load_addon_module("axes").convert_points
    return build_body(skeleton.names, skeleton.parents, convert(skeleton.offsets), convert(skeleton.ends))


def test_rest_pose_of_a_body_stands_on_the_floor(human):
    heads = rest_bones.compute_rest_heads(human)
    ends = np.where(np.isnan(human.ends), 0, human.ends) + heads
    assert min(heads[:, 2].min(), ends[:, 2].min()) == pytest.approx(0)


def test_roll_directions_are_never_along_the_bone(human):
    tails = rest_bones.compute_tail_offsets(human)
    cosines = (rest_bones.find_roll_directions(tails) * tails).sum(1) / np.linalg.norm(tails, axis=1)
    assert np.abs(cosines).max() < 0.85

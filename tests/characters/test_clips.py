"""Clips of a motion, closed to loops."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mocapfix.characters.character import compute_character_poses
from mocapfix.characters.clips import (
    carry_path,
    close_loop,
    find_root_bone,
    find_trimmed_frames,
    name_whole_stride,
    prepare_root_bone,
)
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.options import ROOT_BONE
from tests.characters.walking_body import RATE, build_contacts, load_walk
from tests.io.read_back import motion_of

FRAMES, STRIDE_STOP = slice(88, 163), 158  # of the walk: four frames more than a stride, and the end of that


@pytest.fixture(scope="module")
def walk():
    """A clip of a walk, its character, and when its feet stand."""
    source, motion = load_walk()
    rest = load_cmu31_skeleton()
    skeleton = Skeleton(rest.names, rest.parents, source.skeleton.offsets, rest.ends)
    contacts = build_contacts(skeleton, motion_of(motion.local_rotations, motion.pelvis_position), RATE)
    frames = slice(FRAMES.start, min(FRAMES.stop, motion.frame_count))
    standing = {side: contacts.find_foot_contact(side)[frames] for side in ("left", "right")}
    return source, motion.select_frames(frames), standing


def find_step(character, motion):
    """Return rotation and translation of the pelvis in the plane from the first to the last frame."""
    positions, rotations = compute_character_poses(character, motion)
    turn = rotations[-1, 0] @ rotations[0, 0].T
    yaw = np.arctan2(turn[0, 2] - turn[2, 0], turn[0, 0] + turn[2, 2])
    rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    return rotation, positions[-1, 0] - rotation @ positions[0, 0]


def test_the_last_frame_of_a_walk_is_the_pose_of_the_first_farther_on(walk):
    character, motion, standing = walk
    closed, sentence = close_loop(character, motion, standing)
    positions, _ = compute_character_poses(character, closed)
    rotation, translation = find_step(character, closed)
    np.testing.assert_allclose(positions[0] @ rotation.T + translation, positions[-1], atol=1e-6)
    before = (positions[-1] - positions[-2]) @ rotation
    assert np.linalg.norm(before - (positions[1] - positions[0]), axis=1).max() * RATE < 0.15  # m/s
    original, _ = compute_character_poses(character, motion)
    assert np.linalg.norm(translation - find_step(character, motion)[1]) < 0.05
    middle = slice(len(positions) // 2 - 5, len(positions) // 2 + 5)
    above = [bone for segment in ("pelvis", "head", "left_hand", "right_hand") for bone in character.mapping.bones[segment]]
    np.testing.assert_allclose(positions[middle][:, above], original[middle][:, above], atol=1e-3)
    assert "now by 0.0 mm, 0.0 degrees" in sentence


def test_feet_that_stand_do_not_slide_in_a_loop(walk):
    """Over each contact an ankle moves as it did before, also where the contact goes on through the seam."""
    character, motion, standing = walk
    closed, _ = close_loop(character, motion, standing)
    before, after = (compute_character_poses(character, each)[0] for each in (motion, closed))
    for side in ("left", "right"):
        foot = character.mapping.bones[f"{side}_foot"][0]
        both = standing[side][1:] & standing[side][:-1]
        change = np.diff((after - before)[:, foot][:, [0, 2]], axis=0)
        assert np.linalg.norm(change[both], axis=1).max() * RATE < 0.03  # m/s


def test_a_body_that_stays_returns_to_its_place(walk):
    """A way of some centimetres is closed, and so is the root bone."""
    character, motion, standing = walk
    count = motion.frame_count
    still = replace(motion, pelvis_position=motion.pelvis_position[[0]] + np.linspace(0, 0.05, count)[:, None] * [1, 0, 0])
    closed, sentence = close_loop(character, still, {side: np.zeros(count, bool) for side in standing})
    positions, _ = compute_character_poses(character, closed)
    np.testing.assert_allclose(positions[0], positions[-1], atol=1e-6)
    assert "travels 0.00 m" in sentence


def test_the_root_bone_of_a_loop_has_no_seam(walk):
    """Relative to the root bone the pelvis returns to its place, with its speed."""
    plain, motion, standing = walk
    closed, _ = close_loop(plain, motion, standing)
    character = prepare_root_bone(plain)
    root = find_root_bone(character)
    local = np.insert(closed.local_rotations, root, np.eye(3), axis=1)
    carried = carry_path(character, replace(closed, local_rotations=local), ROOT_BONE, is_loop=True)
    place = carried.pelvis_position
    np.testing.assert_allclose(place[0], place[-1], atol=1e-6)
    assert np.linalg.norm((place[-1] - place[-2]) - (place[1] - place[0])) * RATE < 0.1


def test_a_motion_of_a_few_frames_is_no_loop(walk):
    character, motion, standing = walk
    short = motion.select_frames(slice(0, 4))
    closed, sentence = close_loop(character, short, {side: each[:4] for side, each in standing.items()})
    assert closed is short
    assert sentence == "A loop has at least 5 frames, and the motion 4: it is left as it is."


@pytest.mark.parametrize(
    ("stop", "shift"), [(STRIDE_STOP, ""), (STRIDE_STOP - 14, "(14 frames) later"), (175, "earlier"), (95, "")]
)
def test_the_end_of_a_whole_stride_near_that_of_a_clip_is_named(stop, shift):
    character, motion = load_walk()
    sentence = name_whole_stride(character, motion, slice(FRAMES.start, stop))
    assert shift in sentence
    assert bool(sentence) == bool(shift)


@pytest.mark.parametrize(
    ("trim", "rate", "frames"),
    [
        (None, 120.0, slice(None)),
        ((101, 180), 120.0, slice(0, 80)),
        ((111, 180), 120.0, slice(10, 80)),
        ((103, 109), 30.0, slice(1, 3)),
    ],
)
def test_trimmed_frames_are_numbered_as_in_the_file(trim, rate, frames):
    take = SimpleNamespace(first_frame=101, rate=120.0)
    assert find_trimmed_frames(trim, take, rate) == frames  # pyright: ignore[reportArgumentType]

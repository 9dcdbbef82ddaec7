"""Whole motions on characters, and back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import (
    REQUIRED_SEGMENTS,
    SIDES,
    BoneMapping,
    CharacterMotion,
    compute_character_poses,
)
from mocapfix.characters.load_character import load_character_preset
from mocapfix.characters.retarget_motion import build_solve_tree, compute_segment_targets, retarget_motion
from mocapfix.contacts.contacts import Floor, build_no_contacts
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import change_bones
from tests.characters.walking_body import load_walk, scale_limbs, turn_axes

TURNED = ("Hips", "Spine", "Spine1", "Head", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")


def compute_errors(character, motion, other) -> tuple[float, float]:
    """Return the mean distance in mm and the mean angle in degrees between the joints of two motions."""
    joints = [k for k, name in enumerate(character.skeleton.names) if name.removeprefix("Left").removeprefix("Right") in TURNED]
    (position, rotation), (second, turned) = (compute_character_poses(character, each) for each in (motion, other))
    trace = np.einsum("tjab,tjab->tj", rotation[:, joints], turned[:, joints])
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return float(np.linalg.norm(position - second, axis=-1)[:, joints].mean() * 1e3), float(angle.mean())


def test_the_same_body_keeps_its_motion():
    character, motion = load_walk()
    joints_mm, rotations_deg = compute_errors(character, motion, retarget_motion(character, motion, character))
    assert joints_mm < 0.5  # legs that are nearly straight are bent a little
    assert rotations_deg < 0.1


def test_axes_of_bones_do_not_matter():
    character, motion = load_walk()
    turned = turn_axes(character, np.random.default_rng(5))
    back = retarget_motion(turned, retarget_motion(character, motion, turned), character)
    joints_mm, rotations_deg = compute_errors(character, motion, back)
    assert joints_mm < 1.0
    assert rotations_deg < 0.2


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_motion_returns_from_a_preset(name):
    character, motion = load_walk()
    target = load_character_preset(name)
    there = retarget_motion(character, motion, target)
    np.testing.assert_allclose(np.linalg.det(there.local_rotations), 1.0, atol=1e-9)
    joints_mm, rotations_deg = compute_errors(character, motion, retarget_motion(target, there, character))
    assert joints_mm < 10
    assert rotations_deg < 3


def test_bones_outside_the_body_keep_their_rest_pose():
    character, motion = load_walk()
    target = load_character_preset("mixamo")
    there = retarget_motion(character, motion, target)
    thumb = next(bone for bone, name in enumerate(target.skeleton.names) if "Thumb1" in name)
    assert (there.local_rotations[:, thumb] == target.skeleton.rest_rotations[thumb]).all()


@pytest.mark.parametrize(("legs", "arms"), [(0.7, 1.0), (1.3, 1.0), (1.0, 1.3)])
def test_feet_and_hands_reach_their_targets(legs, arms):
    character, motion = load_walk()
    target = scale_limbs(character, legs, arms)
    frames = build_body_frame(character), build_body_frame(target)
    targets = compute_segment_targets(
        frames, build_solve_tree(frames[1]), compute_segment_motion(frames[0], motion), None, motion.rate
    )
    position, _ = compute_character_poses(target, retarget_motion(character, motion, target))
    for side in SIDES:
        for segment, most_mm in (("foot", 1.0), ("hand", 20.0)):
            wanted = targets.points[f"{side}_{segment}"]
            reached = position[:, target.mapping.bones[f"{side}_{segment}"][0]]
            assert np.linalg.norm(reached - wanted, axis=1).max() * 1e3 < most_mm


def test_foot_that_stands_still_stands_still_on_other_legs():
    character, motion = load_walk()
    target = scale_limbs(character, legs=1.3)
    source_ball, ball = (
        compute_character_poses(each, moved)[0][:, each.mapping.bones["left_toe"][0]]
        for each, moved in ((character, motion), (target, retarget_motion(character, motion, target)))
    )
    source_speed, speed = (np.linalg.norm(np.diff(path, axis=0), axis=1) * motion.rate for path in (source_ball, ball))
    is_standing = source_speed < 0.01
    assert is_standing.sum() > 20
    assert speed[is_standing].max() < 0.02


def test_floor_of_the_character_is_at_height_zero():
    character, motion = load_walk()
    raised = CharacterMotion(motion.pelvis_position + [0.0, 0.3, 0.0], motion.local_rotations, motion.rate)
    target = load_character_preset("mixamo")
    first, second = (
        retarget_motion(character, each, target, contacts=replace(build_no_contacts(each.frame_count, each.rate), floor=floor))
        for each, floor in ((motion, Floor(0.0, 0.0, (0.0,))), (raised, Floor(0.0, 0.0, (0.3,))))
    )
    np.testing.assert_allclose(first.pelvis_position, second.pelvis_position, atol=1e-6)


def test_body_of_the_required_segments_alone():
    character, motion = load_walk()
    bones = {segment: character.mapping.bones[segment] for segment in REQUIRED_SEGMENTS}
    target = replace(character, mapping=BoneMapping(bones))
    there = retarget_motion(character, motion, target)
    position, _ = compute_character_poses(target, there)
    expected, _ = compute_character_poses(character, motion)
    for side in SIDES:
        ankle = bones[f"{side}_foot"][0]
        assert np.linalg.norm(position[:, ankle] - expected[:, ankle], axis=1).max() < 0.002
    assert retarget_motion(target, there, character).frame_count == motion.frame_count


def test_bones_above_the_pelvis_may_be_anywhere():
    character, motion = load_walk()
    target = load_character_preset("unreal")
    root = target.skeleton.find_joint("root")
    positions, rotations = target.skeleton.offsets.copy(), target.skeleton.rest_rotations.copy()
    turn = Rotation.from_euler("xyz", [-90, 20, 10], degrees=True).as_matrix()
    pelvis = target.mapping.bones["pelvis"][0]
    assert target.skeleton.parents[pelvis] == root
    old = target.skeleton.compute_rest_pose()
    positions[root], rotations[root] = [0.5, -0.2, 0.3], turn
    positions[pelvis] = turn.T @ (old[0][pelvis] - positions[root])
    rotations[pelvis] = turn.T @ old[1][pelvis]
    moved = change_bones(target, offsets=positions, rest_rotations=rotations)
    below = [bone for bone in range(len(target.skeleton.names)) if bone != root]
    first, second = (
        compute_character_poses(each, retarget_motion(character, motion, each))[0][:, below] for each in (target, moved)
    )
    np.testing.assert_allclose(first, second, atol=1e-5)


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_very_short_motions(frames):
    character, motion = load_walk()
    brief = CharacterMotion(motion.pelvis_position[:frames], motion.local_rotations[:frames], motion.rate)
    assert retarget_motion(character, brief, load_character_preset("unreal")).frame_count == frames


def test_knees_do_not_pop():
    character, motion = load_walk()
    target = scale_limbs(character, legs=1.3)
    largest = []
    for each, moved in ((character, motion), (target, retarget_motion(character, motion, target))):
        knees = compute_character_poses(each, moved)[0][:, [each.mapping.bones[f"{side}_shin"][0] for side in SIDES]]
        largest.append(np.linalg.norm(np.diff(knees, 2, axis=0), axis=-1).max() / build_body_frame(each).leg_length_m)
    assert largest[1] < 1.2 * largest[0]

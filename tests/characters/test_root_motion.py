"""The path of a character on the floor, carried by a root bone or left out."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.characters.character_files import write_character_bvh, write_character_glb
from mocapfix.characters.clips import (
    FloorPath,
    carry_path,
    find_root_bone,
    measure_floor_path,
    prepare_root_bone,
    smooth_floor_path,
    turn_about_vertical,
)
from mocapfix.characters.load_character import load_character_preset
from mocapfix.io.bvh import read_bvh
from mocapfix.options import ROOT_BONE, ROOT_HIPS, ROOT_IN_PLACE
from tests.characters.character_files import build_figure_character, build_motion, build_vrm, edit_glb, split_glb
from tests.characters.test_character_glb import GLB, check_written_poses, read_figure

RATE = 60.0


def build_turning_walk(character, seconds=4.0) -> CharacterMotion:
    """Return a motion that goes 1.2 m/s along a curve of 40 degrees a second and sways by 8 degrees and 3 cm at 1 Hz."""
    motion = build_motion(character, round(seconds * RATE) + 1, RATE)
    time = np.arange(motion.frame_count) / RATE
    heading, sway = np.deg2rad(40.0) * time, np.sin(2 * np.pi * time)
    yaw = heading + np.deg2rad(8.0) * sway
    place = np.cumsum(1.2 / RATE * np.column_stack([np.sin(heading), np.zeros_like(time), np.cos(heading)]), axis=0)
    place += 0.03 * sway[:, None] * np.column_stack([np.cos(heading), np.zeros_like(time), -np.sin(heading)]) + [0.4, 1.0, -0.7]
    pelvis = character.mapping.bones["pelvis"][0]
    above = int(character.skeleton.parents[pelvis])
    rest_positions, rest_rotations = character.skeleton.compute_rest_pose()
    axes, origin = (rest_rotations[above], rest_positions[above]) if above >= 0 else (np.eye(3), np.zeros(3))
    local = motion.local_rotations.copy()
    local[:, pelvis] = axes.T @ turn_about_vertical(yaw).as_matrix() @ rest_rotations[pelvis]
    return CharacterMotion((place - origin) @ axes, local, RATE)


def carry(character, motion, mode):
    return carry_path(character, motion, mode)


@pytest.mark.parametrize("name", ["mixamo", "unreal", "user"])
def test_a_root_bone_leaves_every_joint_where_it_is_in_the_world(tmp_path, name):
    """The root bone has the smoothed path and the turn about the vertical only, on the floor under the pelvis."""
    character = prepare_root_bone(read_figure(tmp_path) if name == "user" else load_character_preset(name))
    motion = build_turning_walk(character)
    carried = carry(character, motion, ROOT_BONE)
    root, pelvis = find_root_bone(character), character.mapping.bones["pelvis"][0]
    expected, _ = compute_character_poses(character, motion)
    positions, rotations = compute_character_poses(character, carried)
    others = np.arange(len(character.skeleton.names)) >= pelvis
    np.testing.assert_allclose(positions[:, others], expected[:, others], atol=1e-9)
    np.testing.assert_allclose(positions[:, root, 1], character.skeleton.rest_positions[root, 1], atol=1e-9)
    assert np.linalg.norm((positions[:, root] - positions[:, pelvis])[:, [0, 2]], axis=1).max() < 0.12
    turned = rotations[:, root] @ character.skeleton.compute_rest_pose()[1][root].T
    np.testing.assert_allclose(turned[:, 1], np.tile([0.0, 1.0, 0.0], (len(turned), 1)), atol=1e-12)
    yaw = np.unwrap(np.arctan2(turned[:, 0, 2], turned[:, 2, 2]))
    inner = slice(60, -60)
    heading = np.deg2rad(40.0) * np.arange(len(yaw)) / RATE
    assert np.abs(np.rad2deg(yaw - heading))[inner].max() < 1.0  # of 8 degrees of sway


def test_in_place_is_the_same_motion_without_the_path(tmp_path):
    character = read_figure(tmp_path)
    motion = build_turning_walk(character)
    in_place = carry(character, motion, ROOT_IN_PLACE)
    path = smooth_floor_path(measure_floor_path(character, motion), RATE, is_loop=False)
    expected, _ = compute_character_poses(character, motion)
    positions, _ = compute_character_poses(character, in_place)
    pelvis = character.mapping.bones["pelvis"][0]
    moved = np.einsum("tab,tjb->tja", path.rotations, positions) + path.position[:, None]
    np.testing.assert_allclose(moved[:, pelvis:], expected[:, pelvis:], atol=1e-9)
    assert np.abs(positions[:, pelvis, [0, 2]]).max() < 0.12


def test_hips_change_nothing(tmp_path):
    character = read_figure(tmp_path)
    motion = build_turning_walk(character)
    assert carry(character, motion, ROOT_HIPS) is motion


@pytest.mark.parametrize("data", [GLB, build_vrm(0)], ids=["glb", "vrm"])
def test_the_root_bone_of_a_users_file_is_a_joint_that_moves_no_mesh(tmp_path, data):
    plain = read_figure(
        tmp_path, edit_glb(data, lambda document: document["skins"][0].update(skeleton=document["skins"][0]["joints"][0]))
    )
    character = prepare_root_bone(plain)
    motion = carry(character, build_turning_walk(character), ROOT_BONE)
    write_character_glb(tmp_path / "out.glb", character, motion, "take")
    assert character.source is not None
    document = check_written_poses(tmp_path / "out.glb", character, motion, character.source.nodes, atol=4e-6)
    old = json.loads(split_glb(data)[0])
    added = len(old["nodes"])
    skin, old_skin = document["skins"][0], old["skins"][0]
    assert document["nodes"][added]["name"] == "root"
    assert skin["joints"] == [*old_skin["joints"], added]
    assert document["accessors"][skin["inverseBindMatrices"]]["count"] == len(skin["joints"])
    assert document["meshes"] == old["meshes"]
    assert prepare_root_bone(character) is character
    again = read_figure(tmp_path, (tmp_path / "out.glb").read_bytes(), "again.glb")
    assert "root" in again.skeleton.names
    pelvis = plain.mapping.bones["pelvis"][0]
    np.testing.assert_allclose(
        np.delete(character.skeleton.rest_positions, pelvis, axis=0), plain.skeleton.rest_positions, atol=1e-12
    )


def test_a_bvh_has_the_root_bone_with_its_positions(tmp_path):
    character = prepare_root_bone(build_figure_character())
    motion = carry(character, build_turning_walk(character), ROOT_BONE)
    write_character_bvh(tmp_path / "walk.bvh", character, motion)
    animation = read_bvh(tmp_path / "walk.bvh", (tmp_path / "walk.bvh").read_bytes())
    assert animation.names[0] == "root"
    expected, _ = compute_character_poses(character, motion)
    np.testing.assert_allclose(animation.compute_world_poses()[0][:, :2], expected[:, :2], atol=1e-4)


def test_only_a_bone_near_the_floor_is_a_root_bone():
    """The hip of Daz' figures is above the pelvis in the tree, and at its height."""
    character = load_character_preset("unreal")
    raised = replace(character, skeleton=replace(character.skeleton, offsets=character.skeleton.offsets.copy()))
    raised.skeleton.offsets[0] = [0.0, 0.5, 0.0]
    assert find_root_bone(character) == 0
    assert find_root_bone(raised) == -1
    assert find_root_bone(load_character_preset("daz-g8")) == -1


def test_the_heading_is_kept_through_a_somersault():
    """A body that is upside down has no turn about the vertical; the heading before and after counts."""
    character = build_figure_character()
    motion = build_turning_walk(character, 2.0)
    pelvis = character.mapping.bones["pelvis"][0]
    flip = Rotation.from_euler("x", np.linspace(0, 360, motion.frame_count)[:, None], degrees=True)
    rest = character.skeleton.compute_rest_pose()[1][pelvis]
    local = motion.local_rotations.copy()
    local[:, pelvis] = (Rotation.from_euler("y", 30, degrees=True) * flip).as_matrix() @ rest
    path = measure_floor_path(character, replace(motion, local_rotations=local))
    np.testing.assert_allclose(np.rad2deg(path.yaw_rad), 30.0, atol=1e-6)


def test_the_path_of_a_loop_goes_on_as_the_loop_does():
    """Along a circle every cycle continues the curve."""
    angle = np.linspace(0.0, 1.0, 31)
    circle = FloorPath(np.column_stack([1 - np.cos(angle), 0 * angle, np.sin(angle)]), angle)
    longer = circle.continue_path(70)
    wide = np.linspace(-70 / 30, 1 + 70 / 30, 171)
    np.testing.assert_allclose(longer.yaw_rad, wide, atol=1e-12)
    np.testing.assert_allclose(longer.position, np.column_stack([1 - np.cos(wide), 0 * wide, np.sin(wide)]), atol=1e-12)

"""Rotations of segments, and chains with other numbers of bones."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import (
    LIMB_AXES,
    build_body_frame,
    compute_segment_motion,
    keep_chain_direction,
    resample_chain,
)
from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.stats.rigid_alignment import compute_shortest_rotations
from tests.characters.walking_body import load_walk, turn_axes


def bend_chain(count: int, total_deg: float) -> np.ndarray:
    """Return (1, count, 3, 3) rotations that bend evenly about X."""
    return Rotation.from_euler("x", np.linspace(0, total_deg, count)[:, None], degrees=True).as_matrix()[None]


@given(st.integers(2, 7), st.integers(2, 7), st.floats(-120, 120))
def test_an_even_bend_stays_even_with_another_number_of_bones(before, after, total_deg):
    resampled = resample_chain(bend_chain(before, total_deg), after)
    np.testing.assert_allclose(resampled, bend_chain(after, total_deg), atol=1e-9)


def test_chain_keeps_its_ends_and_an_equal_chain_is_the_same():
    rotations = Rotation.random(4, rng=np.random.default_rng(1)).as_matrix()[None]
    resampled = resample_chain(rotations, 6)
    np.testing.assert_allclose(resampled[:, [0, -1]], rotations[:, [0, -1]])
    assert resample_chain(rotations, 4) is rotations
    np.testing.assert_array_equal(resample_chain(rotations[:, :1], 3), np.repeat(rotations[:, :1], 3, axis=1))


def test_interpolation_turns_by_the_share_of_the_angle():
    start, end = np.eye(3)[None], Rotation.from_euler("z", [[80]], degrees=True).as_matrix()
    half = resample_chain(np.stack([start, end], axis=1), 5)[:, 1]
    np.testing.assert_allclose(half, Rotation.from_euler("z", [[20]], degrees=True).as_matrix(), atol=1e-12)


@given(st.integers(0, 2**31))
def test_shortest_rotations_map_one_direction_to_the_other(seed):
    rng = np.random.default_rng(seed)
    before, after = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    rotated = np.einsum("tij,tj->ti", compute_shortest_rotations(before, after), before)
    cosines = np.einsum("ti,ti->t", rotated, after) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    np.testing.assert_allclose(cosines, 1.0, atol=1e-9)


def test_opposite_directions_are_left():
    np.testing.assert_array_equal(compute_shortest_rotations(np.array([[0.0, 1, 0]]), np.array([[0.0, -1, 0]])), np.eye(3)[None])


def test_a_single_bone_points_where_the_chain_of_two_did():
    offsets = np.array([[0.0, 0.1, 0.0], [0.0, 0.1, 0.0]])
    rotations = Rotation.from_euler("x", [[50], [-10]], degrees=True).as_matrix()[None]
    kept = keep_chain_direction(offsets, rotations, np.array([[0.0, 0.2, 0.0]]), np.eye(3)[None, None])
    wanted = np.einsum("tnij,nj->ti", rotations, offsets)[0]
    np.testing.assert_allclose(kept[0, 0] @ [0, 1, 0], wanted / np.linalg.norm(wanted), atol=1e-12)


def test_segments_do_not_depend_on_the_axes_of_the_bones():
    character, motion = load_walk()
    turned = turn_axes(character, np.random.default_rng(3))
    position, rotation = compute_character_poses(character, motion)
    # The same world pose with the other axes: R' = R T, where T are the turns of the axes.
    turns = np.swapaxes(build_body_frame(character).rest_rotation, 1, 2) @ build_body_frame(turned).rest_rotation
    world = rotation @ turns
    local = world.copy()
    local[:, 1:] = np.swapaxes(world[:, turned.skeleton.parents[1:]], 2, 3) @ world[:, 1:]
    same = CharacterMotion(position[:, 0], local, motion.rate)
    first = compute_segment_motion(build_body_frame(character), motion)
    second = compute_segment_motion(build_body_frame(turned), same)
    for segment, expected in first.rotation.items():
        np.testing.assert_allclose(second.rotation[segment], expected, atol=1e-9, err_msg=segment)
    for segment, expected in first.position.items():
        np.testing.assert_allclose(second.position[segment], expected, atol=1e-9, err_msg=segment)


def test_a_forearm_points_to_the_wrist_when_a_joint_within_it_bends():
    """CMU's joint Hand lies in the forearm. A limb that bends there moves the wrist, and the segment points to it."""
    character, motion = load_walk()
    first = CharacterMotion(motion.pelvis_position[:1], motion.local_rotations[:1].copy(), motion.rate)
    hand = character.skeleton.find_joint("LeftHand")
    first.local_rotations[:, hand] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    position, rotation = compute_character_poses(character, first)
    elbow, wrist = (position[0, character.skeleton.find_joint(joint)] for joint in ("LeftForeArm", "LeftFingerBase"))
    segments = compute_segment_motion(build_body_frame(character), first)
    np.testing.assert_allclose(
        segments.rotation["left_forearm"][0] @ LIMB_AXES["left_forearm"],
        (wrist - elbow) / np.linalg.norm(wrist - elbow),
        atol=1e-9,
    )
    np.testing.assert_allclose(segments.rotation["left_hand"][0], rotation[0, hand], atol=1e-9)
    np.testing.assert_array_equal(segments.position["left_hand"][0], wrist)

"""Shares of a limb's twist."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame
from mocapfix.characters.load_character import load_character_preset
from mocapfix.characters.retarget_motion import compute_twist_angle, compute_twisted_bones


def build_rotations(frame, **turned: np.ndarray) -> dict[str, np.ndarray]:
    """Return the identity for every segment but some."""
    return {segment: np.eye(3)[None] for segment in frame.segment_bones} | {name: turn[None] for name, turn in turned.items()}


def measure_twist(frame, bone: int, world: np.ndarray, axis: np.ndarray) -> float:
    """Return the twist in degrees of a bone, whose segment's axes are the world's at rest."""
    return float(np.degrees(compute_twist_angle(world @ frame.standard_rotations[bone].T, axis)[0]))


def test_twist_is_the_turn_about_the_axis_whatever_the_swing():
    twist, swing = Rotation.from_rotvec([0.7, 0, 0]), Rotation.from_rotvec([0, 0.4, 0.9])
    angle = compute_twist_angle((swing * twist).as_matrix()[None], np.array([1.0, 0, 0]))
    assert angle[0] == pytest.approx(0.7)


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
def test_twist_beyond_half_a_turn_does_not_jump(axis):
    angles = np.linspace(0, 1.4 * np.pi, 100)
    swing = Rotation.from_rotvec([0, 0, 1.2])
    rotations = (swing * Rotation.from_rotvec(angles[:, None] * np.array(axis))).as_matrix()
    twist = compute_twist_angle(rotations, np.array(axis))
    assert np.abs(np.diff(twist)).max() < 0.1
    np.testing.assert_allclose(twist, angles, atol=1e-9)


@pytest.mark.parametrize("swing_deg", [30, 100, 150, 170])
@pytest.mark.parametrize("twist_deg", [-60, -5, 5, 80])
@pytest.mark.parametrize("sign", [1, -1])
def test_twist_is_counted_the_short_way_round_from_the_first_frame(swing_deg, twist_deg, sign):
    axis = sign * np.array([0.0, 1.0, 0.0])
    swing, twist = (
        Rotation.from_rotvec(np.deg2rad(swing_deg) * np.array([-1.0, 0, 0])),
        Rotation.from_rotvec(np.deg2rad(twist_deg) * axis),
    )
    angle = np.degrees(compute_twist_angle(np.repeat((swing * twist).as_matrix()[None], 3, axis=0), axis))
    np.testing.assert_allclose(angle, twist_deg, atol=1e-6)


@pytest.mark.parametrize("name", ["unreal", "metahuman"])
def test_bones_beside_a_forearm_take_a_growing_share_of_the_hands_twist(name):
    frame, axis = build_body_frame(load_character_preset(name)), np.array([1.0, 0, 0])
    hand = Rotation.from_rotvec(np.deg2rad(60) * axis).as_matrix()
    twisted = compute_twisted_bones(frame, build_rotations(frame, left_hand=hand))
    beside = frame.character.mapping.twists["left_forearm"]
    places = [float(frame.compute_vector("left_forearm", frame.rest_position[bone])[0]) for bone in beside]
    shares = [measure_twist(frame, bone, twisted[bone], axis) / 60 for bone in beside]
    length = frame.compute_vector("left_forearm", frame.find_head("left_hand"))[0]
    np.testing.assert_allclose(shares, np.clip(np.array(places) / length, 0, 1), atol=1e-6)


def test_chain_of_an_upper_arm_twists_at_its_outer_bone():
    frame, axis = build_body_frame(load_character_preset("daz-g8")), np.array([1.0, 0, 0])
    turn = Rotation.from_rotvec(np.deg2rad(40) * axis).as_matrix()
    twisted = compute_twisted_bones(frame, build_rotations(frame, left_upper_arm=turn))
    inner, outer = frame.character.mapping.bones["left_upper_arm"]
    assert measure_twist(frame, inner, twisted[inner], axis) == pytest.approx(0, abs=1e-6)
    assert measure_twist(frame, outer, twisted[outer], axis) == pytest.approx(40, abs=1e-6)

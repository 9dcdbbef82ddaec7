"""The solve of a character's segments: knees, limits and planes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame
from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.characters.retarget_motion import retarget_motion
from tests.characters.character_files import change_bones
from tests.characters.walking_body import load_walk, scale_limbs


def stand(knee_deg: float = 0.0) -> tuple:
    """Return the average body and a frame of it standing, its legs vertical, with flexed knees."""
    character, motion = load_walk()
    local = character.skeleton.rest_rotations[None].copy()
    for side, spread_deg in (("left", -20.0), ("right", 20.0)):
        bones = character.mapping.bones
        local[:, bones[f"{side}_thigh"][0]] = Rotation.from_euler("z", spread_deg, degrees=True).as_matrix()
        thigh, shin = (
            build_body_frame(character).standard_rotations[bones[f"{side}_{segment}"][0]] for segment in ("thigh", "shin")
        )
        flexion = Rotation.from_euler("x", knee_deg, degrees=True).as_matrix()
        local[:, bones[f"{side}_shin"][0]] = thigh.T @ flexion @ shin
    return character, CharacterMotion(np.array([[0.0, 0.9, 0.0]]), local, motion.rate)


def test_straight_knees_bend_forwards_where_the_target_must_bend():
    character, motion = stand(0.0)
    target = scale_limbs(character, legs=1.0)
    positions = target.skeleton.offsets.copy()
    for side in ("left", "right"):  # a foot that is longer below the ankle, so that the leg has less room
        positions[target.mapping.bones[f"{side}_toe"][0]] += [0.0, -0.03, 0.0]
    target = change_bones(target, offsets=positions)
    position, _ = compute_character_poses(target, retarget_motion(character, motion, target))
    for side in ("left", "right"):
        hip, knee, ankle = (position[0, target.mapping.bones[f"{side}_{segment}"][0]] for segment in ("thigh", "shin", "foot"))
        straight = hip + (ankle - hip) * np.linalg.norm(knee - hip) / np.linalg.norm(ankle - hip)
        assert (knee - straight)[2] > -1e-3
        assert abs((knee - straight)[0]) < 0.02


def test_joint_limits_hold_an_elbow_back_less_than_the_performer_bends_it():
    character, motion = stand()
    elbow = character.mapping.bones["left_forearm"][0]
    local = motion.local_rotations.copy()
    local[:, elbow] = Rotation.from_euler("y", -120, degrees=True).as_matrix()
    bent = CharacterMotion(motion.pelvis_position, local, motion.rate)
    limits_rad = character.skeleton.limits_rad.copy()
    limits_rad[elbow] = np.deg2rad([[-10.0, 10.0], [-60.0, 10.0], [-10.0, 10.0]])
    limited = change_bones(character, limits_rad=limits_rad)
    free_deg, limited_deg = (
        np.degrees(
            np.linalg.norm(Rotation.from_matrix(retarget_motion(character, bent, each).local_rotations[0, elbow]).as_rotvec())
        )
        for each in (character, limited)
    )
    assert free_deg == pytest.approx(120, abs=1)
    assert 60 < limited_deg < free_deg - 3

"""Where pelvis and feet shall be."""

import numpy as np
import pytest

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import SIDES, CharacterMotion
from mocapfix.characters.kept_positions import compute_kept_positions, measure_flat_feet, scale_positions
from tests.characters.walking_body import load_walk, scale_limbs


def test_heights_are_scaled_from_the_floor():
    scaled = scale_positions(np.array([[1.0, 0.35, 2.0]]), 2.0, 0.15, 0.05)
    np.testing.assert_allclose(scaled, [[2.0, 0.45, 4.0]])


def test_targets_on_the_same_body_are_its_own_joints():
    character, motion = load_walk()
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    kept = compute_kept_positions(frame, frame, segments, measure_flat_feet(frame, segments, None))
    np.testing.assert_allclose(kept.pelvis, segments.position["pelvis"], atol=1e-9)
    for side in SIDES:
        np.testing.assert_allclose(kept.ankles[side], segments.position[f"{side}_foot"], atol=1e-9)


@pytest.mark.parametrize("legs", [0.7, 1.3])
def test_a_ball_that_stands_still_stands_still_on_other_legs(legs):
    character, motion = load_walk()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, legs=legs))
    segments = compute_segment_motion(source, motion)
    kept = compute_kept_positions(source, target, segments, measure_flat_feet(source, segments, None), floor_height_m=0.02)
    for side in SIDES:
        foot = segments.rotation[f"{side}_foot"]
        ball = segments.position[f"{side}_foot"] + foot @ source.compute_ball(side)
        target_ball = kept.ankles[side] + foot @ target.compute_ball(side)
        np.testing.assert_allclose(np.diff(target_ball, axis=0), legs * np.diff(ball, axis=0), atol=1e-12)


def test_hips_have_the_same_height_in_leg_lengths():
    character, motion = load_walk()
    still = CharacterMotion(motion.pelvis_position[:1], motion.local_rotations[:1], motion.rate)
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, legs=1.3))
    segments = compute_segment_motion(source, still)
    kept = compute_kept_positions(source, target, segments, measure_flat_feet(source, segments, None))
    pelvis = segments.rotation["pelvis"][0]
    heights = [
        float((root + pelvis @ frame.hip_centre)[1]) - frame.ankle_height_m
        for frame, root in ((source, segments.position["pelvis"][0]), (target, kept.pelvis[0]))
    ]
    assert heights[1] / heights[0] == pytest.approx(1.3, rel=1e-6)

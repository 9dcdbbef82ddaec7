"""Feet within reach of the legs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.characters.body_frames import build_body_frame
from mocapfix.characters.kept_positions import KeptPositions, compute_bearing, keep_feet_within_reach, limit_distance
from tests.characters.walking_body import load_walk


@given(st.floats(0.0, 3.0), st.floats(0.3, 1.5))
def test_distance_never_exceeds_the_leg_and_small_ones_are_kept(distance, leg_length_m):
    limited = float(limit_distance(np.array([distance]), leg_length_m)[0])
    assert limited <= leg_length_m
    if distance <= 0.98 * leg_length_m:
        assert limited == distance


def test_distance_approaches_the_leg_length_without_a_jump_of_its_slope():
    distances = np.linspace(0.9, 1.2, 3001)
    slope = np.diff(limit_distance(distances, 1.0)) / np.diff(distances)
    assert (slope >= 0).all()
    assert np.abs(np.diff(slope)).max() < 0.01


def test_a_leg_below_its_hip_bears_the_body_and_a_kick_does_not():
    np.testing.assert_array_equal(compute_bearing(np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 1.0, 0]])), [1, 0, 0])


def place_feet(height_m: float, ahead_m: float = 0.0) -> tuple[KeptPositions, KeptPositions, float]:
    """Return targets with ankles below the hips by `height_m` and ahead, those within reach, and the leg's length."""
    character, _ = load_walk()
    frame = build_body_frame(character)
    pelvis = np.array([[0.0, 1.0, 0.0]])
    ankles = {
        side: pelvis + frame.compute_vector("pelvis", frame.find_head(f"{side}_thigh")) + [0.0, -height_m, ahead_m]
        for side in ("left", "right")
    }
    kept = KeptPositions(pelvis, ankles)
    return kept, keep_feet_within_reach(frame, kept, np.eye(3)[None]), frame.leg_length_m


def test_feet_that_bent_legs_reach_stay():
    kept, within, _ = place_feet(0.7)
    np.testing.assert_array_equal(within.pelvis, kept.pelvis)
    np.testing.assert_allclose(within.ankles["left"], kept.ankles["left"], atol=1e-12)


def test_pelvis_is_lowered_to_standing_feet_out_of_reach():
    character, _ = load_walk()
    leg_m = build_body_frame(character).leg_length_m
    kept, within, _ = place_feet(1.05 * leg_m)
    assert within.pelvis[0, 1] < kept.pelvis[0, 1] - 0.04 * leg_m
    np.testing.assert_allclose(within.ankles["left"], kept.ankles["left"], atol=1e-9)


def test_a_kicking_foot_out_of_reach_comes_nearer():
    character, _ = load_walk()
    leg_m = build_body_frame(character).leg_length_m
    kept, within, _ = place_feet(0.0, 1.2 * leg_m)
    np.testing.assert_array_equal(within.pelvis, kept.pelvis)
    ahead = kept.ankles["left"] - within.ankles["left"]
    assert ahead[0, 2] == pytest.approx(0.2 * leg_m, rel=1e-3)

"""Where the hands shall be."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import CharacterMotion
from mocapfix.characters.kept_positions import (
    NEAR_DISTANCE,
    compute_hand_targets,
    compute_nearness,
    find_nearest_point,
    keep_palms_together,
    limit_reach,
    move_hands_out_of_thighs,
    split_along_line,
)
from tests.characters.walking_body import load_walk, scale_limbs


@given(st.integers(0, 2**31))
def test_nearest_point_is_nearer_than_any_other_of_the_line(seed):
    rng = np.random.default_rng(seed)
    point, start, end = rng.normal(size=(3, 1, 3))
    share, vector = find_nearest_point(point, start, end)
    assert 0 <= share[0] <= 1
    shares = np.linspace(0, 1, 101)[:, None]
    assert np.linalg.norm(vector) <= np.linalg.norm(point - start - shares * (end - start), axis=1).min() + 1e-12


def test_nearness_falls_from_one_to_zero():
    values = compute_nearness(np.linspace(0, 1, 50))
    assert values[0] == 1.0
    assert values[-1] == 0.0
    assert (np.diff(values) <= 0).all()


def test_target_out_of_reach_is_moved_towards_the_shoulder():
    limited = limit_reach(np.array([[2.0, 0, 0], [0.1, 0, 0]]), np.zeros((2, 3)), 0.5)
    assert np.linalg.norm(limited[0]) == pytest.approx(0.4995)
    np.testing.assert_array_equal(limited[1], [0.1, 0, 0])


def pose_t(frames: int = 1):
    """Return the average body in its rest pose: a T-pose, its hands far from everything."""
    character, motion = load_walk()
    rest = np.tile(character.skeleton.rest_rotations, (frames, 1, 1, 1))
    return character, CharacterMotion(np.tile([0.0, 1.0, 0.0], (frames, 1)), rest, motion.rate)


def test_free_hand_keeps_direction_and_share_of_the_arm():
    character, motion = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    segments = compute_segment_motion(source, motion)
    hands = compute_hand_targets(source, target, segments, segments.position)
    shoulder = segments.position["left_upper_arm"][0]
    expected = shoulder + 1.3 * (segments.position["left_hand"][0] - shoulder)
    np.testing.assert_allclose(hands["left"][0], expected, atol=2e-3)  # a thousandth of the arm is kept back from its full reach


def hang_arms(character, spread_deg: float) -> CharacterMotion:
    """Return the body standing with straight arms that hang at an angle to the vertical."""
    _, still = pose_t()
    local = still.local_rotations.copy()
    for side, sign in (("left", -1), ("right", 1)):
        turn = Rotation.from_euler("z", sign * (90 - spread_deg), degrees=True).as_matrix()
        local[:, character.mapping.bones[f"{side}_upper_arm"][0]] = turn
    return CharacterMotion(still.pelvis_position, local, still.rate)


def test_longer_arms_that_hang_beside_the_thighs_stay_straight():
    character, _ = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.15))
    segments = compute_segment_motion(source, hang_arms(character, 8.0))
    hands = compute_hand_targets(source, target, segments, segments.position)
    reach = np.linalg.norm(hands["left"] - segments.position["left_upper_arm"], axis=1)
    assert reach == pytest.approx(target.arm_length_m, rel=0.01)


def test_palms_that_touch_still_touch_with_longer_arms():
    source_palms = {"left": np.array([[0.02, 1.2, 0.3]]), "right": np.array([[-0.02, 1.2, 0.3]])}
    palms = {"left": np.array([[-0.05, 1.2, 0.35]]), "right": np.array([[0.07, 1.25, 0.4]])}
    kept = keep_palms_together(source_palms, palms, 0.45, 2.0)
    np.testing.assert_allclose(kept["left"] - kept["right"], [[0.08, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(kept["left"] + kept["right"], palms["left"] + palms["right"], atol=1e-12)


def test_hands_that_clap_clap_with_longer_arms():
    character, still = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    local = still.local_rotations.copy()
    for side, sign in (("left", -1), ("right", 1)):  # arms ahead, pointing inwards until the palms nearly touch
        turn = Rotation.from_euler("y", sign * 110, degrees=True).as_matrix()
        local[:, character.mapping.bones[f"{side}_upper_arm"][0]] = turn
    segments = compute_segment_motion(source, CharacterMotion(still.pelvis_position, local, still.rate))
    hands = compute_hand_targets(source, target, segments, segments.position)
    palms, source_palms = (
        {side: place[side] + segments.rotation[f"{side}_hand"] @ frame.compute_palm(side) for side in ("left", "right")}
        for frame, place in ((target, hands), (source, {side: segments.position[f"{side}_hand"] for side in ("left", "right")}))
    )
    apart, source_apart = (each["left"] - each["right"] for each in (palms, source_palms))
    assert np.linalg.norm(source_apart) < NEAR_DISTANCE * source.trunk_length_m
    np.testing.assert_allclose(apart, source_apart, atol=1e-3)


def test_palm_before_the_trunk_keeps_its_distance_from_the_trunk():
    character, motion = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    segments = compute_segment_motion(source, motion)
    positions, rotation = dict(segments.position), segments.rotation["left_hand"]
    middle = (positions["pelvis"] + positions["neck"]) / 2
    positions["left_hand"] = middle + [0.0, 0.0, 0.1] - rotation @ source.compute_palm("left")
    hands = compute_hand_targets(source, target, replace(segments, position=positions), segments.position)
    palm = hands["left"] + rotation @ target.compute_palm("left")
    across = split_along_line(palm, positions["pelvis"], positions["neck"])[1]
    expected = split_along_line(middle + [0.0, 0.0, 0.1], positions["pelvis"], positions["neck"])[1]
    np.testing.assert_allclose(across, expected, atol=1e-6)


def test_palm_that_came_too_near_to_a_thigh_is_moved_out():
    character, motion = pose_t()
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    positions = dict(segments.position)
    hand = segments.rotation["left_hand"]
    middle = (positions["left_thigh"] + positions["left_shin"]) / 2
    positions["left_hand"] = middle + [0.05, 0.0, 0.0] - hand @ frame.compute_palm("left")
    wanted = {"left": positions["left_hand"], "right": positions["right_hand"]}
    moved = move_hands_out_of_thighs(frame, frame, segments, positions, wanted)
    np.testing.assert_array_equal(moved["right"], wanted["right"])
    palm = moved["left"] + hand @ frame.compute_palm("left")
    distance = np.linalg.norm(find_nearest_point(palm, positions["left_thigh"], positions["left_shin"])[1])
    assert distance == pytest.approx(NEAR_DISTANCE * frame.trunk_length_m, rel=0.05)

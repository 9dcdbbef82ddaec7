"""Displacements with which limbs bend as the source's."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.characters.kept_positions import compute_kept_positions, measure_flat_feet
from mocapfix.characters.limb_fit import (
    NEAR_DISTANCE,
    PUSH_ACCELERATION,
    TOUCH_DISTANCE,
    DisplacementProblem,
    compute_nearness,
    compute_pushes,
    fit_arms,
    fit_legs,
    spread_push,
)
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import NO_FLOOR, Floor, build_no_contacts
from mocapfix.stats.rigid_alignment import find_nearest_points, split_along_line
from tests.characters.character_files import change_bones
from tests.characters.walking_body import RATE, load_walk, scale_limbs


def test_nearness_falls_from_one_to_zero():
    values = compute_nearness(np.linspace(0, 1, 50))
    assert values[0] == 1.0
    assert values[-1] == 0.0
    assert (np.diff(values) <= 0).all()


def pose_t(frames: int = 1):
    """Return the average body in its rest pose: a T-pose, its hands far from everything."""
    character, motion = load_walk()
    rest = np.tile(character.skeleton.rest_rotations, (frames, 1, 1, 1))
    return character, CharacterMotion(np.tile([0.0, 1.0, 0.0], (frames, 1)), rest, motion.rate)


def test_free_hand_keeps_direction_and_share_of_the_arm():
    character, motion = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    segments = compute_segment_motion(source, motion)
    hands = fit_arms((source, target), segments, segments.position, RATE)
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
    hands = fit_arms((source, target), segments, segments.position, RATE)
    reach = np.linalg.norm(hands["left"] - segments.position["left_upper_arm"], axis=1)
    assert reach == pytest.approx(target.compute_length("upper_arm", "forearm", "hand"), rel=0.01)


def test_hands_that_clap_clap_with_longer_arms():
    character, still = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    local = still.local_rotations.copy()
    for side, sign in (("left", -1), ("right", 1)):  # arms ahead, pointing inwards until the palms nearly touch
        turn = Rotation.from_euler("y", sign * 110, degrees=True).as_matrix()
        local[:, character.mapping.bones[f"{side}_upper_arm"][0]] = turn
    segments = compute_segment_motion(source, CharacterMotion(still.pelvis_position, local, still.rate))
    hands = fit_arms((source, target), segments, segments.position, RATE)
    palms, source_palms = (
        {side: place[side] + segments.rotation[f"{side}_hand"] @ frame.compute_palm(side) for side in ("left", "right")}
        for frame, place in ((target, hands), (source, {side: segments.position[f"{side}_hand"] for side in ("left", "right")}))
    )
    apart, source_apart = (each["left"] - each["right"] for each in (palms, source_palms))
    assert np.linalg.norm(source_apart) < NEAR_DISTANCE * source.trunk_length_m
    np.testing.assert_allclose(apart, source_apart, atol=5e-3)


def test_palm_before_the_trunk_keeps_its_distance_from_the_trunk():
    character, motion = pose_t()
    source, target = build_body_frame(character), build_body_frame(scale_limbs(character, arms=1.3))
    segments = compute_segment_motion(source, motion)
    positions, rotation = dict(segments.position), segments.rotation["left_hand"]
    hips = (positions["left_thigh"] + positions["right_thigh"]) / 2
    middle = (hips + positions["neck"]) / 2
    positions["left_hand"] = middle + [0.0, 0.0, 0.08] - rotation @ source.compute_palm("left")
    hands = fit_arms((source, target), replace(segments, position=positions), segments.position, RATE)
    palm = hands["left"] + rotation @ target.compute_palm("left")
    across = split_along_line(palm, hips, positions["neck"])[1]
    expected = split_along_line(middle + [0.0, 0.0, 0.08], hips, positions["neck"])[1]
    np.testing.assert_allclose(across[:, 2], expected[:, 2], atol=0.01)


def test_palm_that_came_too_near_to_a_thigh_stays_out():
    """A wider thigh moves nothing: the source's palm is beside its thigh, and the target's starts within its own."""
    character, motion = pose_t()
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    positions, start = dict(segments.position), dict(segments.position)
    hand = segments.rotation["left_hand"]
    middle = (positions["left_thigh"] + positions["left_shin"]) / 2
    source_m = 0.21 * frame.trunk_length_m
    positions["left_hand"] = middle + [source_m, 0.0, 0.0] - hand @ frame.compute_palm("left")
    start["left_upper_arm"] = start["left_upper_arm"] - [0.08, 0.0, 0.0]
    hands = fit_arms((frame, frame), replace(segments, position=positions), start, RATE)
    palm = hands["left"] + hand @ frame.compute_palm("left")
    assert source_m < TOUCH_DISTANCE * frame.trunk_length_m
    assert np.linalg.norm(find_nearest_points(palm, start["left_thigh"], start["left_shin"])[1]) > source_m - 0.01


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_takes_of_few_frames_are_solved(frames):
    problem = DisplacementProblem(np.full((frames, 1, 1), 4.0) * np.eye(3), np.full((frames, 3), 2.0))
    none = np.zeros((frames, 3))
    np.testing.assert_allclose(problem.solve(none, none, 1.0, 60.0), 0.5)


def test_course_gives_its_accelerations():
    seconds = np.arange(60) / 60.0
    course = np.column_stack([np.sin(9.0 * seconds), np.zeros(60), seconds])
    problem = DisplacementProblem(np.full((60, 1, 1), 1e-6) * np.eye(3), np.zeros((60, 3)))
    solved = problem.solve(np.zeros((60, 3)), course, 1.0, 60.0)
    np.testing.assert_allclose(np.diff(solved, n=2, axis=0), np.diff(course, n=2, axis=0), atol=1e-6)


def swing_leg(legs: tuple[float, float], flexion_deg: np.ndarray):
    """Return a body with a left and a right leg of other lengths, in the air, whose left knee bends, and its segments."""
    character, _ = load_walk()
    unequal = scale_limbs(character, legs=legs[0])
    offsets = unequal.skeleton.offsets.copy()
    right = [unequal.mapping.bones[f"right_{segment}"][0] for segment in ("shin", "foot")]
    offsets[right] *= legs[1] / legs[0]
    source = change_bones(unequal, offsets=offsets)
    local = np.tile(source.skeleton.rest_rotations, (len(flexion_deg), 1, 1, 1))
    frame = build_body_frame(source)
    thigh, shin = (source.mapping.bones[f"left_{segment}"][0] for segment in ("thigh", "shin"))
    knee = Rotation.from_euler("x", flexion_deg[:, None], degrees=True).as_matrix()
    local[:, thigh] = local[:, thigh] @ Rotation.from_euler("x", -flexion_deg[:, None], degrees=True).as_matrix()
    local[:, shin] = frame.standard_rotations[thigh].T @ knee @ frame.standard_rotations[shin]
    moved = CharacterMotion(np.tile([0.0, 1.5, 0.0], (len(flexion_deg), 1)), local, RATE)
    return character, source, moved


def test_legs_of_other_lengths_bend_by_the_angles_of_the_source():
    """Under one scale the shorter leg would be stretched, and the longer one bent."""
    target, source, motion = swing_leg((0.97, 1.03), np.full(30, 3.0))
    frames = build_body_frame(source), build_body_frame(target)
    segments = compute_segment_motion(frames[0], motion)
    kept = compute_kept_positions(*frames, segments, measure_flat_feet(frames[0], segments, None))
    fitted = fit_legs(frames, segments, kept, segments.position, None, RATE)
    for side, flexion_deg in (("left", 3.0), ("right", 0.0)):
        hip = fitted.pelvis + segments.rotation["pelvis"] @ frames[1].compute_vector(
            "pelvis", frames[1].find_head(f"{side}_thigh")
        )
        names = [f"{side}_{segment}" for segment in ("thigh", "shin", "foot")]
        expected = frames[1].compute_way(names) * np.cos(np.deg2rad(flexion_deg / 2))
        np.testing.assert_allclose(np.linalg.norm(fitted.ankles[side] - hip, axis=1), expected, atol=1e-3)


def test_a_leg_that_straightens_and_bends_again_keeps_its_plane():
    """The knee of a longer leg moves forwards and back, never to the side, also while the source's is straight."""
    flexion_deg = 30.0 * np.abs(np.cos(np.linspace(0, np.pi, 61))) ** 2
    target, source, motion = swing_leg((0.96, 1.0), flexion_deg)
    position, _ = compute_character_poses(target, retarget_motion(source, motion, target))
    expected, _ = compute_character_poses(source, motion)
    hip, knee, ankle = (
        [places[:, each.mapping.bones[f"left_{segment}"][0]] for places, each in ((position, target), (expected, source))]
        for segment in ("thigh", "shin", "foot")
    )
    normals = [np.cross(knee[k] - hip[k], ankle[k] - knee[k]) for k in (0, 1)]
    is_bent = flexion_deg > 4.0
    unit, wanted = (each[is_bent] / np.linalg.norm(each[is_bent], axis=1, keepdims=True) for each in normals)
    assert (np.einsum("ti,ti->t", unit, wanted) > np.cos(np.deg2rad(5))).all()
    acceleration, source_acceleration = (np.linalg.norm(np.diff(each, n=2, axis=0), axis=1).max() for each in knee)
    assert acceleration < 1.3 * source_acceleration


def test_a_foot_in_contact_keeps_its_displacement():
    character, motion = load_walk()
    target = scale_limbs(character, legs=1.3)
    frames = build_body_frame(character), build_body_frame(target)
    segments = compute_segment_motion(frames[0], motion)
    kept = compute_kept_positions(*frames, segments, measure_flat_feet(frames[0], segments, None))
    contacts = replace(build_no_contacts(motion.frame_count, RATE), is_known=np.ones((motion.frame_count, 4), bool))
    contacts.is_contact[40:80, :2] = True
    fitted = fit_legs(frames, segments, kept, segments.position, contacts, RATE)
    displacement = fitted.ankles["left"] - kept.ankles["left"]
    assert np.abs(displacement).max() > 1e-3
    assert np.abs(np.diff(displacement[40:80], axis=0)).max() * RATE < 0.001
    assert np.abs(displacement[40:80, 1]).max() < 0.002


def test_a_sole_that_would_be_in_the_floor_is_lifted_above_it():
    character, motion = load_walk()
    frames = build_body_frame(character), build_body_frame(scale_limbs(character, legs=1.3))
    segments = compute_segment_motion(frames[0], motion)
    kept = compute_kept_positions(*frames, segments, measure_flat_feet(frames[0], segments, None))
    highest = 60 + int(np.argmax(kept.ankles["left"][60:120, 1]))
    clearance = 0.02 - 0.04 * np.exp(-(((np.arange(motion.frame_count) - highest) / 8.0) ** 2))  # 20 mm in the floor there
    free, held = (
        fit_legs(frames, segments, replace(kept, clearances_m=each), segments.position, None, RATE).ankles["left"]
        for each in ({}, {"left": clearance})
    )
    height = kept.ankles["left"][:, 1]
    assert (free[:, 1] - height + clearance).min() < -0.01
    assert (held[:, 1] - height + clearance).min() > -0.005
    assert np.abs(held - free)[180:].max() < 1e-3


def build_floor(character, motion, clearance_m: float) -> Floor:
    """Return a floor so far below the lowest place of the left palm."""
    source = build_body_frame(character)
    palm = compute_segment_motion(source, motion).carry("left_hand", source.compute_palm("left"))
    return Floor(0.0, 0.0, (float(palm[:, 1].min()) - clearance_m,))


def test_nothing_is_pushed_that_is_where_the_source_is():
    character, motion = load_walk()
    source = build_body_frame(character)
    segments = compute_segment_motion(source, motion)
    pushes = compute_pushes((source, source), segments, segments.position, Floor(0.0, 0.0, (0.0,)), motion.rate)
    assert set(pushes) == {"pelvis", "left_hand", "right_hand", "left_foot", "right_foot"}
    assert max(np.abs(push).max() for push in pushes.values()) < 1e-9


def test_a_hand_below_the_floor_is_pushed_up_to_where_it_rests():
    """The palm rests at 0.035 lengths of the leg above the floor; its wrist is 200 mm lower than the source's in one frame."""
    character, motion = load_walk()
    source, floor = build_body_frame(character), build_floor(character, motion, 0.1)
    segments = compute_segment_motion(source, motion)
    lowest = int(np.argmin(segments.carry("left_hand", source.compute_palm("left"))[:, 1]))
    solved = {name: place - [0.0, floor.height_m, 0.0] for name, place in segments.position.items()}  # with the floor at height 0
    solved["left_hand"][lowest, 1] -= 0.2
    pushes = compute_pushes((source, source), segments, solved, floor, motion.rate)
    assert pushes["left_hand"][lowest, 1] == pytest.approx(0.1 + 0.035 * source.leg_length_m, abs=0.02)
    assert pushes["left_hand"][:, 1].min() >= 0.0
    nothing = compute_pushes((source, source), segments, solved, NO_FLOOR, motion.rate)
    assert np.abs(nothing["left_hand"][lowest, 1]) < 0.05


def test_the_mesh_of_a_hand_is_pushed_out_of_the_floor():
    """A vertex at the end of the fingers is 200 mm from the wrist, which comes within 100 mm of the floor."""
    character, motion = load_walk()
    wrist = character.skeleton.rest_positions[character.mapping.bones["left_hand"][0]]
    source = build_body_frame(character)
    target = build_body_frame(replace(character, hulls={"left_hand": wrist + [[0.2, 0.0, 0.0]]}))
    segments = compute_segment_motion(source, motion)
    lowest_m = float(segments.position["left_hand"][:, 1].min()) - 0.1
    solved = {name: place - [0.0, lowest_m, 0.0] for name, place in segments.position.items()}  # with the floor at height 0
    push = compute_pushes((source, target), segments, solved, Floor(0.0, 0.0, (lowest_m,)), motion.rate)["left_hand"]
    vertex = solved["left_hand"] + push + segments.rotation["left_hand"] @ target.compute_hull("left_hand")[0]
    assert (vertex - push)[:, 1].min() < -0.03
    assert vertex[:, 1].min() > -1e-6


def test_a_push_begins_and_ends_smoothly_and_covers_what_is_needed():
    push = np.zeros(480)
    push[240:250] = 0.2
    spread = spread_push(push, 120.0, 0.9)
    assert (spread >= push - 1e-12).all()
    assert spread.max() == pytest.approx(0.2)
    assert spread[:150].max() == spread[340:].max() == 0.0
    assert np.abs(np.diff(np.sqrt(spread / 0.9), 2)).max() * 120.0**2 < 1.01 * PUSH_ACCELERATION


@pytest.mark.parametrize(("height_m", "lift_m"), [(1.0, 0.3), (0.0, 0.02)])
def test_a_head_in_the_floor_lifts_the_body_as_far_as_feet_on_the_floor_let_it(height_m, lift_m):
    character, motion = load_walk()
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    solved = {name: place + [0.0, height_m, 0.0] for name, place in segments.position.items()}
    solved["head"][60, 1] = 0.11 * frame.leg_length_m - 0.3
    pushes = compute_pushes((frame, frame), segments, solved, Floor(0.0, 0.0, (0.0,)), motion.rate)
    assert pushes["pelvis"][60, 1] == pytest.approx(lift_m, abs=0.02)
    for end in ("left_hand", "right_hand", "left_foot", "right_foot") if height_m else ():
        assert pushes[end][60, 1] == pytest.approx(lift_m, abs=0.02)


def test_a_palm_that_passes_a_thigh_is_pushed_off_it_without_a_jump():
    """The source's palm passes 50 mm beside the thigh's axis, where the direction away from it turns by 140 degrees in 0.1 s."""
    character, motion = load_walk()
    source, still = build_body_frame(character), np.zeros(motion.frame_count, int)
    segments = compute_segment_motion(source, motion)
    position = {name: place[still] for name, place in segments.position.items()}
    rotation = {name: each[still] for name, each in segments.rotation.items()}
    middle = (position["left_thigh"] + position["left_shin"]) / 2
    time_s = (np.arange(len(still)) - len(still) // 2) / motion.rate
    way = np.stack([np.full(len(still), 0.05), np.zeros(len(still)), 3.0 * time_s], axis=1)
    position["left_hand"] = middle + way - rotation["left_hand"] @ source.compute_palm("left")
    solved = {**position, "left_hand": position["left_hand"] - 0.5 * np.clip(way, -0.05, 0.05)}
    motion_past = replace(segments, position=position, rotation=rotation)
    push = compute_pushes((source, source), motion_past, solved, NO_FLOOR, motion.rate)["left_hand"]
    assert np.linalg.norm(push, axis=1).max() > 0.015
    assert np.linalg.norm(np.diff(push, n=2, axis=0), axis=1).max() * motion.rate**2 < 30.0


@pytest.mark.parametrize("legs", [0.7, 1.0])
def test_palms_of_a_character_stay_above_the_floor(legs):
    """Short legs let the hands hang deeper, as a share of the legs; the source's palms come within 20 mm of the floor."""
    character, motion = load_walk()
    target, floor = scale_limbs(character, legs, 1.0), build_floor(character, motion, 0.02)
    contacts = replace(build_no_contacts(motion.frame_count, motion.rate), floor=floor)
    frame, moved = build_body_frame(target), retarget_motion(character, motion, target, contacts=contacts)
    segments = compute_segment_motion(frame, moved)
    palm = segments.carry("left_hand", frame.compute_palm("left"))[:, 1]
    assert palm.min() > legs * 0.02 - 0.005

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.characters.body_frames import DOWN, build_body_frame
from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.characters.character_choice import load_character_preset
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import build_no_contacts
from mocapfix.io.character_files import list_moving_bones
from mocapfix.io.gltf import write_gltf
from mocapfix.io.key_reduction import (
    MAX_STANDING_ERROR_M,
    build_leg_curves,
    measure_key_reduction,
    reduce_position_keys,
    reduce_rotation_keys,
    select_motion_keys,
)
from mocapfix.kernels.key_reduction import interpolate_keys, measure_key_error
from mocapfix.stats.rigid_alignment import compute_shortest_rotation
from tests.characters.character_files import build_figure_character, build_motion
from tests.characters.walking_body import load_walk
from tests.io.read_back import SKELETON, motion_of, smooth_rotations


def make_quaternions(seed, frames, swing):
    quaternions = Rotation.from_matrix(smooth_rotations(seed, frames, 1, swing)[:, 0]).as_quat()
    for t in range(1, frames):
        quaternions[t] *= -1 if quaternions[t] @ quaternions[t - 1] < 0 else 1
    return quaternions


def compute_angles(one, other):
    return (Rotation.from_quat(one).inv() * Rotation.from_quat(other)).magnitude()


def interpolate(keys, values, kind):
    """Return values between keys by scipy's slerp, or linearly in the components and normalised."""
    times = np.arange(len(values))
    if len(keys) == 1:
        return np.repeat(values[keys], len(values), axis=0)
    if kind == "slerp":
        return Slerp(keys, Rotation.from_quat(values[keys]))(times).as_quat()
    return np.stack([np.interp(times, keys, column) for column in values[keys].T], axis=1)  # from_quat normalises


@given(seed=st.integers(0, 2**32), frames=st.integers(2, 200), swing=st.floats(0.01, 6), limit=st.floats(1e-4, 0.5))
def test_rotations_stay_within_the_limit_in_every_frame(seed, frames, swing, limit):
    quaternions = make_quaternions(seed, frames, swing)
    keys = reduce_rotation_keys(quaternions, limit)
    assert keys[0] == 0
    assert len(keys) == 1 or keys[-1] == frames - 1
    largest = max(compute_angles(interpolate(keys, quaternions, kind), quaternions).max() for kind in ("slerp", "linear"))
    assert largest <= limit + 1e-7
    kept = np.isin(np.arange(frames), keys)
    assert measure_key_error(quaternions, kept, True) == pytest.approx(largest, abs=1e-7)
    np.testing.assert_allclose(
        compute_angles(interpolate_keys(quaternions, kept, True), interpolate(keys, quaternions, "slerp")), 0, atol=1e-7
    )


@given(seed=st.integers(0, 2**32), frames=st.integers(1, 200), limit=st.floats(1e-4, 1))
def test_positions_stay_within_the_limit_in_every_frame(seed, frames, limit):
    positions = np.cumsum(np.random.default_rng(seed).normal(size=(frames, 3)) * 0.05, axis=0)
    keys = reduce_position_keys(positions, limit)
    assert keys[0] == 0
    assert keys[-1] == frames - 1
    between = np.stack([np.interp(np.arange(frames), keys, column) for column in positions[keys].T], axis=1)
    largest = np.linalg.norm(between - positions, axis=1).max()
    assert largest <= limit * (1 + 1e-9)
    kept = np.isin(np.arange(frames), keys)
    assert measure_key_error(positions, kept, False) == pytest.approx(largest, abs=1e-9)
    np.testing.assert_allclose(interpolate_keys(positions, kept, False), between, atol=1e-12)


def test_a_uniform_rotation_has_a_key_every_third_of_a_turn_at_most():
    angles = np.radians(np.arange(361.0))
    quaternions = np.stack([np.sin(angles / 2), 0 * angles, 0 * angles, np.cos(angles / 2)], axis=1)
    keys = reduce_rotation_keys(quaternions, np.radians(3))
    assert np.diff(keys).max() <= 120
    assert len(keys) <= 7  # linear interpolation of the components alone is off by more than 3 degrees over longer spans


def test_a_path_of_straight_lines_has_keys_at_its_corners():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 1]], float)
    positions = np.stack([np.interp(np.arange(301), [0, 100, 200, 300], column) for column in corners.T], axis=1)
    assert reduce_position_keys(positions, 1e-6).tolist() == [0, 100, 200, 300]


def test_constant_curves_have_one_key_but_positions_two():
    quaternions = np.tile([0.5, 0.5, 0.5, 0.5], (50, 1))
    assert reduce_rotation_keys(quaternions, 1e-6).tolist() == [0]
    assert reduce_position_keys(np.ones((50, 3)), 1e-6).tolist() == [0, 49]
    assert reduce_position_keys(np.ones((1, 3)), 1e-6).tolist() == [0]


def test_a_lower_limit_keeps_more_keys():
    quaternions = make_quaternions(3, 400, 2.0)
    counts = [len(reduce_rotation_keys(quaternions, np.radians(limit))) for limit in (5, 1, 0.2, 0.01)]
    assert counts == sorted(counts)
    assert counts[0] < 30


def test_without_a_limit_every_frame_is_a_key_except_of_constant_rotations():
    rotations = smooth_rotations(1, 30, 3, swing=1.0)
    rotations[:, 1] = rotations[5, 1]
    keys = select_motion_keys((0, 1, 2), rotations, np.zeros((30, 3)), None, 0.9)
    assert [int(kept.sum()) for kept in keys.rotation_keys] == [30, 1, 30]
    assert keys.position_keys.all()
    assert keys.key_count == 91


def test_a_long_take_is_reduced_in_a_second():
    rotations = np.tile(smooth_rotations(1, 1000, 60, swing=1.0), (10, 1, 1, 1))
    select_motion_keys(range(60), rotations[:20], np.zeros((20, 3)), 0.01, 0.9)  # compile
    started = time.process_time()
    keys = select_motion_keys(range(60), rotations, np.zeros((10_000, 3)), np.radians(0.5), 0.9)
    assert time.process_time() - started < 1.0
    assert keys.key_count < 0.5 * 10_000 * 60


def test_the_solved_skeleton_states_its_largest_error(tmp_path):
    motion = motion_of(smooth_rotations(2, 240, 31, swing=1), np.cumsum(np.full((240, 3), 0.001), axis=0))
    assert write_gltf(tmp_path / "all.glb", SKELETON, motion, 120.0) is None
    reduction = write_gltf(tmp_path / "few.glb", SKELETON, motion, 120.0, np.radians(1))
    assert reduction is not None
    assert 0.5 < reduction.max_error_deg <= 1.0
    assert 0 < reduction.max_distance_m < 0.1
    assert (tmp_path / "few.glb").stat().st_size < 0.8 * (tmp_path / "all.glb").stat().st_size


def check_standing_feet(name, degrees, frames=240):
    """Return the reduction of a squat on feet that stand, after checking the feet's places with scipy."""
    character, motion = build_squat(name, frames)
    legs = build_leg_curves(character, motion)
    assert legs.standing.all()
    arguments = list_moving_bones(character, motion), motion.local_rotations, motion.pelvis_position, np.radians(degrees), 0.9
    keys = select_motion_keys(*arguments, legs)
    places, _ = compute_character_poses(character, motion)
    feet = [
        character.mapping.bones[f"{side}_{segment}"][0]
        for side in ("left", "right")
        for segment in ("foot", "toe")
        if f"{side}_{segment}" in character.mapping.bones
    ]
    for kind in ("slerp", "linear"):
        local = motion.local_rotations.copy()
        for bone, rotation, kept in zip(keys.bones, keys.rotations, keys.rotation_keys, strict=True):
            between = interpolate(np.flatnonzero(kept), rotation, kind)
            assert compute_angles(between, rotation).max() <= np.radians(degrees) + 1e-7
            local[:, bone] = Rotation.from_quat(between).as_matrix()
        kept = np.flatnonzero(keys.position_keys)
        position = np.stack([np.interp(np.arange(frames), kept, column) for column in keys.position[kept].T], axis=1)
        moved, _ = compute_character_poses(character, CharacterMotion(position, local, motion.rate))
        assert np.linalg.norm(moved[:, feet] - places[:, feet], axis=-1).max() <= MAX_STANDING_ERROR_M + 1e-7
    return keys, select_motion_keys(*arguments)


def build_squat(name, frames=240, rate=60.0):
    """Return a figure that squats and shifts its weight on feet that stand, by the angles of two bones of known lengths."""
    source, _ = load_walk()
    target = load_character_preset(name)
    frame = build_body_frame(source)
    thigh, shin = frame.compute_length("thigh", "shin"), frame.compute_length("shin", "foot")
    time = np.linspace(0, 2 * np.pi, frames)
    local = np.tile(source.rest_rotations, (frames, 1, 1, 1))
    hips = np.zeros((frames, 3))
    bones = source.mapping.bones
    rest, _ = source.compute_rest_pose()
    reach = 0.95 * (thigh + shin) - 0.25 * (thigh + shin) * np.sin(time / 2) ** 2 - 0.02 * np.sin(5 * time) ** 2
    sway = 0.06 * np.sin(3 * time)
    for side in ("left", "right"):
        knee = np.pi - np.arccos((thigh**2 + shin**2 - reach**2) / (2 * thigh * shin))
        hip = -np.arcsin(shin * np.sin(knee) / reach)
        upright = compute_shortest_rotation(rest[bones[f"{side}_shin"][0]] - rest[bones[f"{side}_thigh"][0]], DOWN)
        lower = compute_shortest_rotation(rest[bones[f"{side}_foot"][0]] - rest[bones[f"{side}_shin"][0]], DOWN)
        lean = Rotation.from_euler("z", np.arcsin(sway / reach)[:, None]).as_matrix()
        thighs = lean @ Rotation.from_euler("x", hip[:, None]).as_matrix() @ upright
        shins = lean @ Rotation.from_euler("x", (hip + knee)[:, None]).as_matrix() @ lower
        local[:, bones[f"{side}_thigh"][0]] = thighs
        local[:, bones[f"{side}_shin"][0]] = thighs.swapaxes(1, 2) @ shins
        local[:, bones[f"{side}_foot"][0]] = shins.swapaxes(1, 2)
    hips[:, 0], hips[:, 1] = -sway, np.sqrt(reach**2 - sway**2)
    return target, retarget_motion(source, CharacterMotion(hips, local, rate), target)


@pytest.mark.parametrize("name", ["unreal", "mixamo", "smpl"])
@pytest.mark.parametrize("degrees", [0.3, 1.0, 4.0])
def test_standing_feet_stay_where_they_are(name, degrees):
    keys, freely = check_standing_feet(name, degrees)
    assert keys.key_count < 0.5 * (len(keys.position) * (len(keys.bones) + 1))
    assert keys.key_count < 2.5 * freely.key_count


def test_feet_without_the_limit_slide_which_is_stated():
    character, motion = build_squat("unreal")
    legs = build_leg_curves(character, motion)
    bones = list_moving_bones(character, motion)
    freely = select_motion_keys(bones, motion.local_rotations, motion.pelvis_position, np.radians(1), 0.9)
    held = select_motion_keys(bones, motion.local_rotations, motion.pelvis_position, np.radians(1), 0.9, legs)
    slides = [
        measure_key_reduction(keys, motion.local_rotations, np.radians(1), lambda position, _: position[:, None], legs)
        for keys in (freely, held)
    ]
    before, after = (reduction.max_standing_m for reduction in slides)
    assert before is not None
    assert after is not None
    assert before > 3 * MAX_STANDING_ERROR_M
    assert 0 < after <= MAX_STANDING_ERROR_M * (1 + 1e-6)
    assert f"and standing feet {1000 * after:.2g} mm." in slides[1].sentence


def test_only_contacts_of_a_foot_hold_it():
    """Contacts at half the rate, of the left foot in the first half: what is not in contact has keys of its own."""
    character, motion = build_squat("unreal")
    contacts = build_known_contacts(120, 30.0)
    unheld = build_leg_curves(character, motion, contacts)
    assert not unheld.standing.any()
    arguments = list_moving_bones(character, motion), motion.local_rotations, motion.pelvis_position, np.radians(2), 0.9
    freely = select_motion_keys(*arguments)
    assert select_motion_keys(*arguments, unheld).key_count == freely.key_count
    contacts.is_contact[:60, :2] = True
    legs = build_leg_curves(character, motion, contacts)
    assert legs.standing[:118, :2].all()
    assert not legs.standing[122:].any()
    assert not legs.standing[:, 2:].any()
    keys = select_motion_keys(*arguments, legs)
    count_of = {
        side: sum(int(keys.rotation_keys[keys.bones.index(bone)].sum()) for bone in list_leg_bones(character, side))
        - sum(int(freely.rotation_keys[freely.bones.index(bone)].sum()) for bone in list_leg_bones(character, side))
        for side in ("left", "right")
    }
    assert count_of["left"] > 0
    assert count_of["right"] == 0
    reduction = measure_key_reduction(keys, motion.local_rotations, np.radians(2), lambda position, _: position[:, None], legs)
    assert reduction.max_standing_m is not None
    assert reduction.max_standing_m <= MAX_STANDING_ERROR_M * (1 + 1e-6)


def build_known_contacts(frames, rate):
    """Return the contacts of feet that markers show and that are never in contact."""
    contacts = build_no_contacts(frames, rate)
    return replace(contacts, is_known=np.ones_like(contacts.is_known))


def list_leg_bones(character, side):
    return [bone for segment in ("thigh", "shin", "foot") for bone in character.mapping.bones[f"{side}_{segment}"]]


@given(seed=st.integers(0, 2**32), degrees=st.floats(0.2, 8), frames=st.integers(1, 150))
@settings(max_examples=30)
def test_any_contacts_are_kept(seed, degrees, frames):
    rng = np.random.default_rng(seed)
    character = build_figure_character()
    motion = build_motion(character, frames, seed=seed)
    contacts = build_known_contacts(frames, motion.rate)
    for column in range(4):
        for start in rng.integers(0, frames, 3):
            contacts.is_contact[start : start + rng.integers(1, 60), column] = True
    legs = build_leg_curves(character, motion, contacts)
    bones = list_moving_bones(character, motion)
    keys = select_motion_keys(bones, motion.local_rotations, motion.pelvis_position, np.radians(degrees), 0.9, legs)
    reduction = measure_key_reduction(
        keys, motion.local_rotations, np.radians(degrees), lambda position, _: position[:, None], legs
    )
    assert all(kept[0] for kept in (*keys.rotation_keys, keys.position_keys))
    assert all(kept.sum() == 1 or kept[-1] for kept in keys.rotation_keys)
    assert keys.position_keys[-1]
    assert reduction.max_error_deg <= degrees + 1e-5
    assert reduction.max_standing_m is not None
    assert reduction.max_standing_m <= MAX_STANDING_ERROR_M * (1 + 1e-6)


def test_a_long_take_of_standing_feet_is_reduced_in_two_seconds():
    character, motion = build_squat("unreal", 500)
    bones = list_moving_bones(character, motion)
    position, rotations = np.tile(motion.pelvis_position, (20, 1)), np.tile(motion.local_rotations, (20, 1, 1, 1))
    longer = CharacterMotion(position, rotations, motion.rate)
    for each in (motion, longer):  # the first compiles
        started = time.process_time()
        legs = build_leg_curves(character, each)
        keys = select_motion_keys(bones, each.local_rotations, each.pelvis_position, np.radians(0.5), 0.9, legs)
    assert time.process_time() - started < 2.0
    assert keys.key_count < 0.5 * 10_000 * len(bones)

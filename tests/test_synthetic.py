"""Synthetic takes: anatomical motion, individual bodies, and damage that matches its masks."""

from dataclasses import fields

import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix import synthetic as motions
from mocapfix import synthetic as synthetic_takes
from mocapfix.errors import WriteError
from mocapfix.io.capture import read_take
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import SyntheticTake, compose_take, write_synthetic_take

RATE = 120.0
WALKING = slice(round(1.0 * RATE), round(3.2 * RATE))


@pytest.fixture(scope="module")
def take() -> SyntheticTake:
    return compose_take(seed=0)


@pytest.fixture(scope="module")
def position_of(take):
    """Positions (T, 3) of a joint, by its name."""
    return lambda name: take.joint_positions[:, take.subject.skeleton.find_joint(name)]


def compute_angle_deg(a, b):
    return np.degrees(np.arccos(np.sum(a * b, axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)))


# The feet


@pytest.fixture(scope="module")
def feet() -> motions.FootMotion:
    return motions.plan_footsteps(np.arange(0, 20, 1 / 240), stride_m=0.6, half_width_m=0.09)


@pytest.mark.parametrize(("pivot", "sign"), [(motions.TOE_PIVOT_M, 1), (motions.HEEL_PIVOT_M, -1)])
def test_stance_foot_rolls_about_a_fixed_point_of_the_floor(feet, pivot, sign):
    pitch = -feet.foot_rotation[..., 1, 2] * sign  # sine of the pitch of heel or toes
    point = feet.ankle_position + feet.foot_rotation @ [0, -motions.ANKLE_HEIGHT_M, pivot]
    rolling = ~feet.is_swinging & (pitch > -1e-12)
    both = rolling[1:] & rolling[:-1]
    assert (pitch[rolling] > 0.05).sum() > 100
    assert np.abs(np.diff(point, axis=0)[both]).max() < 1e-9
    assert np.abs(point[rolling][:, 1]).max() < 1e-9


def test_one_foot_is_always_in_stance_and_the_walk_returns_to_the_start(feet):
    assert not feet.is_swinging.all(axis=1).any()
    assert feet.is_swinging.any(axis=1).mean() > 0.3
    np.testing.assert_allclose(feet.floor_position[-1], feet.floor_position[0], atol=1e-9)
    np.testing.assert_allclose(feet.yaw_rad[-1], 2 * np.pi)


# The body


def test_bones_keep_the_subjects_lengths(take):
    skeleton = take.subject.skeleton
    bones = take.joint_positions[:, 1:] - take.joint_positions[:, skeleton.parents[1:]]
    lengths = np.linalg.norm(skeleton.offsets[1:], axis=1)
    assert np.abs(np.linalg.norm(bones, axis=2) - lengths).max() < 1e-9


def test_legs_reach_their_feet(take, position_of):
    skeleton = take.subject.skeleton
    leg = sum(float(np.linalg.norm(skeleton.offsets[skeleton.find_joint(name)])) for name in ("LeftLeg", "LeftFoot"))
    half_width = skeleton.offsets[skeleton.find_joint("LeftUpLeg"), 0]
    feet = motions.plan_footsteps(np.arange(len(take.joint_positions)) / RATE, motions.STRIDE_TO_LEG_RATIO * leg, half_width)
    for side, name in enumerate(("LeftFoot", "RightFoot")):
        assert (
            np.abs(position_of(name) - feet.ankle_position[:, side]).max() < 1e-4
        )  # thigh and shin are collinear at rest up to this


@pytest.mark.parametrize("seed", range(4))
def test_joints_move_smoothly(seed):
    joints = compose_take(seed).joint_positions
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=2) * RATE
    acceleration = np.linalg.norm(np.diff(joints, 2, axis=0), axis=2) * RATE**2
    jerk = np.linalg.norm(np.diff(joints, 3, axis=0), axis=2) * RATE**3
    assert speed.max() < 5.5  # a swinging foot; m/s
    assert acceleration.max() < 50  # m/s2
    assert jerk.max() < 2500  # m/s3: a jump of a millimetre in one frame would give 1728


def test_motion_does_not_depend_on_the_rate():
    slow, fast = compose_take(3, rate=60.0), compose_take(3, rate=240.0)
    assert np.abs(slow.joint_positions - fast.joint_positions[::4]).max() < 0.005


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_below_the_floor(seed):
    take = compose_take(seed)
    skeleton = take.subject.skeleton
    position, rotation = kinematics.compute_world_poses(skeleton, take.motion)
    toes = [skeleton.find_joint(name) for name in ("LeftToeBase", "RightToeBase")]
    ends = position[:, toes] + np.einsum("tjab,jb->tja", rotation[:, toes], skeleton.ends[toes])
    assert min(position[..., 1].min(), ends[..., 1].min()) > 0
    assert position[:, toes, 1].min() < 0.07


def test_knees_and_elbows_bend_anatomically(position_of):
    for side in ("Left", "Right"):
        thigh, shin = (
            position_of(f"{side}Leg") - position_of(f"{side}UpLeg"),
            position_of(f"{side}Foot") - position_of(f"{side}Leg"),
        )
        knee = compute_angle_deg(thigh, shin)
        assert 5 < knee.min() < 20
        assert 45 < knee[WALKING].max() < 75
        assert 75 < knee.max() < 130
        forward = position_of(f"{side}ToeBase") - position_of(f"{side}Foot")
        knee_forward = position_of(f"{side}Leg") - (position_of(f"{side}UpLeg") + position_of(f"{side}Foot")) / 2
        assert np.sum(forward * knee_forward, axis=1).min() > 0
        upper, fore = (
            position_of(f"{side}ForeArm") - position_of(f"{side}Arm"),
            position_of(f"{side}Hand") - position_of(f"{side}ForeArm"),
        )
        assert 0 < compute_angle_deg(upper, fore).min() < compute_angle_deg(upper, fore).max() < 70


def test_arms_hang_and_swing_against_the_legs(position_of):
    for side in ("Left", "Right"):
        assert (position_of(f"{side}Hand")[WALKING, 1] < position_of(f"{side}Arm")[WALKING, 1] - 0.3).all()
        hand, foot = ((position_of(f"{side}{part}") - position_of("Hips"))[WALKING, 2] for part in ("Hand", "Foot"))
        assert np.corrcoef(hand, foot)[0, 1] < -0.8
    hips = position_of("Hips")[WALKING]
    assert 0.8 < (hips[-1, 2] - hips[0, 2]) / 2.2 < 1.4  # m/s
    assert 0.015 < np.ptp(hips[:, 1]) < 0.07  # bob
    assert 0.005 < np.ptp(hips[:, 0]) < 0.06  # sway


def test_hands_reach_and_the_body_crouches_and_turns(position_of):
    def at(when):
        return round(np.mean(when[1:3]) * RATE)

    left, right, crouch = at(motions.REACH_LEFT_TIMES_S), at(motions.REACH_RIGHT_TIMES_S), at(motions.CROUCH_TIMES_S)
    assert abs(position_of("LeftHand")[left, 1] - position_of("LeftArm")[left, 1]) < 0.15
    assert position_of("LeftHand")[left, 2] - position_of("LeftArm")[left, 2] > 0.4
    assert position_of("RightHand")[right, 1] > position_of("Head")[right, 1]
    assert position_of("Hips")[crouch, 1] < position_of("Hips")[left, 1] - 0.2
    across = position_of("LeftUpLeg")[-1] - position_of("RightUpLeg")[-1]
    assert compute_angle_deg(across, np.array([-1.0, 0, 0])) < 5


# The person


def test_markers_have_placement_errors_on_an_individual_body(take):
    nominal = load_marker_set("cmu41")
    errors = [compose_take(seed, 0.1).subject.marker_offsets - nominal.marker_offsets for seed in range(10)]
    assert np.std(errors) == pytest.approx(0.012, rel=0.1)
    body = load_cmu31_body()
    own, average = (np.linalg.norm(s.offsets, axis=1) for s in (take.subject.skeleton, body.skeleton))
    for joints in body.bone_groups.values():
        scales = own[list(joints)] / average[list(joints)]
        assert np.ptp(scales) < 1e-12
        assert 0 < abs(scales[0] - 1) < 0.16


def test_asymmetric_person_has_different_bones_on_each_side():
    symmetric, asymmetric = (compose_take(7, 0.5, asymmetric=value).subject for value in (False, True))
    lengths = [np.linalg.norm(one.skeleton.offsets, axis=1) for one in (symmetric, asymmetric)]
    names = symmetric.skeleton.names
    thighs = [names.index("LeftLeg"), names.index("RightLeg")]
    assert lengths[0][thighs[0]] == lengths[0][thighs[1]]
    assert lengths[1][thighs[0]] != lengths[1][thighs[1]]
    ratio = lengths[1][lengths[0] > 0] / lengths[0][lengths[0] > 0]
    assert 0.015 < ratio.std() < 0.05
    along = (symmetric.skeleton.offsets * asymmetric.skeleton.offsets).sum(1)
    lean = np.arccos(np.clip(along / np.maximum(lengths[0] * lengths[1], 1e-9), -1, 1))
    limbs = [j for j, name in enumerate(names) if name.endswith(("Leg", "ForeArm", "Hand", "Foot")) and "Up" not in name]
    np.testing.assert_allclose(lean[limbs], 0, atol=1e-6)  # limbs lie along their own axes
    assert lean[names.index("LeftArm")] > 0.01
    for shoulder in ("LeftShoulder", "RightShoulder"):
        np.testing.assert_array_equal(
            asymmetric.skeleton.offsets[names.index(shoulder)], asymmetric.skeleton.offsets[names.index("Neck")]
        )


def test_skin_slides_smoothly_by_millimetres():
    take = compose_take(2, seconds=20.0)
    rigid = kinematics.compute_joint_and_marker_positions(take.subject, take.motion)[1]
    slide = take.marker_positions - rigid
    assert np.std(slide) == pytest.approx(0.004, rel=0.05)
    lag = round(0.3 * RATE)
    rotation = kinematics.compute_world_poses(take.subject.skeleton, take.motion)[1][:, take.subject.joints]
    local = np.einsum("tkba,tkb->tka", rotation, slide)
    assert np.mean(local[lag:] * local[:-lag]) / np.var(local) == pytest.approx(np.exp(-1), abs=0.05)
    noise = np.diff(local, 2, axis=0)  # second differences of the camera noise have 1 + 4 + 1 variances
    assert np.std(noise) / np.sqrt(6) == pytest.approx(0.0003, rel=0.1)


# The damage


@pytest.mark.parametrize("seed", range(4))
def test_damage_matches_its_masks(seed):
    take = compose_take(seed)
    np.testing.assert_array_equal(np.isnan(take.damaged_positions).any(axis=2), take.missing_mask)
    untouched = ~take.missing_mask & ~take.spike_mask
    np.testing.assert_array_equal(take.damaged_positions[untouched], take.marker_positions[untouched])
    assert not (take.missing_mask & take.spike_mask).any()
    jump = np.linalg.norm(take.damaged_positions - take.marker_positions, axis=2)[take.spike_mask]
    assert len(jump) > 5
    assert jump.min() > 0.0299
    assert 0.02 < take.missing_mask.mean() < 0.12
    lengths = [last - first + 1 for m in range(take.missing_mask.shape[1]) for first, last in find_runs(take.missing_mask[:, m])]
    assert sum(length < 0.2 * RATE for length in lengths) >= 15
    assert sum(length >= 0.5 * RATE for length in lengths) >= 7 + 2  # the arm's six, the late start, and others


def test_arm_gap_and_late_marker(take):
    first, end = (round(second * RATE) for second in synthetic_takes.ARM_GAP_S)
    assert 0 < synthetic_takes.ARM_GAP_S[0] < synthetic_takes.ARM_GAP_S[1] <= motions.REACH_LEFT_TIMES_S[0]
    lost = {label for label, missing in zip(take.labels, take.missing_mask[first:end].all(axis=0), strict=True) if missing}
    assert lost >= {"LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN"}
    assert take.missing_mask[: round(synthetic_takes.LATE_START_S * RATE)].all(axis=0).sum() >= 1


def test_take_depends_on_the_seed_only():
    one, same, other = (compose_take(seed, 2.0) for seed in (5, 5, 6))
    for field in fields(SyntheticTake):
        if isinstance(value := getattr(one, field.name), np.ndarray):
            np.testing.assert_array_equal(value, getattr(same, field.name))
    assert np.abs(one.marker_positions - other.marker_positions).max() > 0.01
    assert (one.missing_mask != other.missing_mask).any()


@settings(max_examples=6)
@given(seconds=st.floats(0.1, 12), rate=st.floats(25, 300), seed=st.integers(0, 2**32))
def test_any_length_and_rate_gives_a_complete_body(seconds, rate, seed):
    take = compose_take(seed, seconds, rate)
    assert take.damaged_positions.shape == (round(seconds * rate), len(take.labels), 3)
    assert np.isfinite(take.joint_positions).all()
    assert np.isfinite(take.marker_positions).all()


# The file


def test_c3d_file_contains_the_take(take, tmp_path):
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, take)
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    assert tuple(point["LABELS"]["value"]) == take.labels
    assert (point["UNITS"]["value"], point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["mm"], ["+X"], ["+Z"])
    assert point["RATE"]["value"] == [RATE]
    header = file["header"]["points"]
    assert (header["first_frame"], header["last_frame"]) == (0, len(take.damaged_positions) - 1)  # counted from 0 by ezc3d
    xyz = file["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(xyz[..., [1, 2, 0]] / 1000, take.damaged_positions, atol=1e-6)  # NaN and all; 32-bit floats
    stored = np.frombuffer(path.read_bytes(), "<f4", take.missing_mask.size * 4, (point["DATA_START"]["value"][0] - 1) * 512)
    np.testing.assert_array_equal(stored.reshape(-1, 4)[~take.missing_mask.ravel(), 3], 0)  # measured, nothing filled
    np.testing.assert_array_equal(stored.reshape(-1, 4)[take.missing_mask.ravel()], [[0, 0, 0, -1]] * take.missing_mask.sum())


def test_c3d_file_is_read_back(take, tmp_path):
    write_synthetic_take(tmp_path / "walk.c3d", take)
    found = read_take(tmp_path / "walk.c3d")
    assert (found.labels, found.rate, found.first_frame) == (take.labels, RATE, 1)
    np.testing.assert_allclose(found.markers, take.damaged_positions, atol=1e-6)


def test_missing_folder_is_named(take, tmp_path):
    with pytest.raises(WriteError, match="nowhere"):
        write_synthetic_take(tmp_path / "nowhere" / "walk.c3d", take)

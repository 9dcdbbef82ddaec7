"""The composed take: a person who walks, and damage that is where it is said to be."""

from dataclasses import fields

import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix import marker_sets, synthetic
from mocapfix.errors import WriteError
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.stats.runs import find_runs
from mocapfix.synthetic import damage, footsteps, gestures, motions

RATE = 120.0
WALKING = slice(round(1.0 * RATE), round(3.2 * RATE))


@pytest.fixture(scope="module")
def truth() -> synthetic.SyntheticTake:
    return synthetic.compose_take(seed=0)


@pytest.fixture(scope="module")
def place(truth):
    """-> where a named joint is, (T, 3)."""
    return lambda name: truth.joints[:, truth.subject.skeleton.index(name)]


def angle(a, b):
    return np.degrees(np.arccos(np.sum(a * b, axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)))


# The feet


@pytest.fixture(scope="module")
def feet() -> footsteps.FootMotion:
    return footsteps.plan_footsteps(np.arange(0, 20, 1 / 240), stride_m=0.6, half_width_m=0.09)


@pytest.mark.parametrize(("pivot", "sign"), [(footsteps.TOE_PIVOT_M, 1), (footsteps.HEEL_PIVOT_M, -1)])
def test_stance_foot_rolls_about_a_fixed_point_of_the_floor(feet, pivot, sign):
    pitch = -feet.rotation[..., 1, 2] * sign  # the sine of how far heel or toes are up
    point = feet.ankle_position + feet.rotation @ [0, -footsteps.ANKLE_HEIGHT_M, pivot]
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


def test_bones_keep_the_subjects_lengths(truth):
    skeleton = truth.subject.skeleton
    bones = truth.joints[:, 1:] - truth.joints[:, skeleton.parents[1:]]
    lengths = np.linalg.norm(skeleton.offsets[1:], axis=1)
    assert np.abs(np.linalg.norm(bones, axis=2) - lengths).max() < 1e-9


def test_legs_reach_their_feet(truth, place):
    skeleton = truth.subject.skeleton
    leg = sum(float(np.linalg.norm(skeleton.offsets[skeleton.index(name)])) for name in ("LeftLeg", "LeftFoot"))
    half_width = skeleton.offsets[skeleton.index("LeftUpLeg"), 0]
    feet = footsteps.plan_footsteps(np.arange(len(truth.joints)) / RATE, motions.STRIDE_TO_LEG_RATIO * leg, half_width)
    for side, name in enumerate(("LeftFoot", "RightFoot")):
        assert np.abs(place(name) - feet.ankle_position[:, side]).max() < 1e-4  # thigh and shin rest in one line to that


@pytest.mark.parametrize("seed", range(4))
def test_joints_move_smoothly(seed):
    joints = synthetic.compose_take(seed).joint_positions
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=2) * RATE
    acceleration = np.linalg.norm(np.diff(joints, 2, axis=0), axis=2) * RATE**2
    jerk = np.linalg.norm(np.diff(joints, 3, axis=0), axis=2) * RATE**3
    assert speed.max() < 5.5  # a swinging foot; m/s
    assert acceleration.max() < 50  # m/s2
    assert jerk.max() < 2500  # m/s3: one frame's jump by a millimetre would make 1728 of it alone


def test_motion_does_not_depend_on_the_rate():
    slow, fast = synthetic.compose_take(3, rate=60.0), synthetic.compose_take(3, rate=240.0)
    assert np.abs(slow.joint_positions - fast.joint_positions[::4]).max() < 0.005


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_below_the_floor(seed):
    truth = synthetic.compose_take(seed)
    skeleton = truth.subject.skeleton
    position, rotation = kinematics.compute_world_poses(skeleton, truth.motion)
    toes = [skeleton.find_joint(name) for name in ("LeftToeBase", "RightToeBase")]
    ends = position[:, toes] + np.einsum("tjab,jb->tja", rotation[:, toes], skeleton.ends[toes])
    assert min(position[..., 1].min(), ends[..., 1].min()) > 0
    assert position[:, toes, 1].min() < 0.07


def test_knees_and_elbows_bend_anatomically(place):
    for side in ("Left", "Right"):
        thigh, shin = place(f"{side}Leg") - place(f"{side}UpLeg"), place(f"{side}Foot") - place(f"{side}Leg")
        knee = angle(thigh, shin)
        assert 5 < knee.min() < 20
        assert 45 < knee[WALKING].max() < 75
        assert 75 < knee.max() < 130
        forward = place(f"{side}ToeBase") - place(f"{side}Foot")
        knee_forward = place(f"{side}Leg") - (place(f"{side}UpLeg") + place(f"{side}Foot")) / 2
        assert np.sum(forward * knee_forward, axis=1).min() > 0
        upper, fore = place(f"{side}ForeArm") - place(f"{side}Arm"), place(f"{side}Hand") - place(f"{side}ForeArm")
        assert 0 < angle(upper, fore).min() < angle(upper, fore).max() < 70


def test_arms_hang_and_swing_against_the_legs(place):
    for side in ("Left", "Right"):
        assert (place(f"{side}Hand")[WALKING, 1] < place(f"{side}Arm")[WALKING, 1] - 0.3).all()
        hand, foot = ((place(f"{side}{part}") - place("Hips"))[WALKING, 2] for part in ("Hand", "Foot"))
        assert np.corrcoef(hand, foot)[0, 1] < -0.8
    hips = place("Hips")[WALKING]
    assert 0.8 < (hips[-1, 2] - hips[0, 2]) / 2.2 < 1.4  # m/s
    assert 0.015 < np.ptp(hips[:, 1]) < 0.07  # bob
    assert 0.005 < np.ptp(hips[:, 0]) < 0.06  # sway


def test_hands_reach_and_the_body_crouches_and_turns(place):
    def at(when):
        return round(np.mean(when[1:3]) * RATE)

    left, right, crouch = at(gestures.REACH_LEFT_TIMES_S), at(gestures.REACH_RIGHT_TIMES_S), at(gestures.CROUCH_TIMES_S)
    assert abs(place("LeftHand")[left, 1] - place("LeftArm")[left, 1]) < 0.15
    assert place("LeftHand")[left, 2] - place("LeftArm")[left, 2] > 0.4
    assert place("RightHand")[right, 1] > place("Head")[right, 1]
    assert place("Hips")[crouch, 1] < place("Hips")[left, 1] - 0.2
    across = place("LeftUpLeg")[-1] - place("RightUpLeg")[-1]
    assert angle(across, np.array([-1.0, 0, 0])) < 5


# The person


def test_markers_have_placement_errors_on_an_individual_body(truth):
    nominal = marker_sets.load_marker_set("cmu41")
    strays = [synthetic.compose_take(seed, 0.1).subject.marker_offsets - nominal.marker_offsets for seed in range(10)]
    assert np.std(strays) == pytest.approx(0.012, rel=0.1)
    body = load_cmu31_body()
    own, average = (np.linalg.norm(s.offsets, axis=1) for s in (truth.subject.skeleton, body.skeleton))
    for joints in body.bone_groups.values():
        scales = own[list(joints)] / average[list(joints)]
        assert np.ptp(scales) < 1e-12
        assert 0 < abs(scales[0] - 1) < 0.16


def test_asymmetric_person_has_different_bones_on_each_side():
    straight, crooked = (synthetic.compose_take(7, 0.5, asymmetric=which).subject for which in (False, True))
    lengths = [np.linalg.norm(one.skeleton.offsets, axis=1) for one in (straight, crooked)]
    names = straight.skeleton.names
    thighs = [names.index("LeftLeg"), names.index("RightLeg")]
    assert lengths[0][thighs[0]] == lengths[0][thighs[1]]
    assert lengths[1][thighs[0]] != lengths[1][thighs[1]]
    ratio = lengths[1][lengths[0] > 0] / lengths[0][lengths[0] > 0]
    assert 0.015 < ratio.std() < 0.05
    along = (straight.skeleton.offsets * crooked.skeleton.offsets).sum(1)
    turned = np.arccos(np.clip(along / np.maximum(lengths[0] * lengths[1], 1e-9), -1, 1))
    limbs = [j for j, name in enumerate(names) if name.endswith(("Leg", "ForeArm", "Hand", "Foot")) and "Up" not in name]
    np.testing.assert_allclose(turned[limbs], 0, atol=1e-6)  # they lie along their own axes
    assert turned[names.index("LeftArm")] > 0.01
    for shoulder in ("LeftShoulder", "RightShoulder"):
        np.testing.assert_array_equal(
            crooked.skeleton.offsets[names.index(shoulder)], crooked.skeleton.offsets[names.index("Neck")]
        )


def test_skin_slides_smoothly_by_millimetres():
    truth = synthetic.compose_take(2, seconds=20.0)
    rigid = kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)[1]
    slide = truth.marker_positions - rigid
    assert np.std(slide) == pytest.approx(0.004, rel=0.05)
    lag = round(0.3 * RATE)
    rotation = kinematics.compute_world_poses(truth.subject.skeleton, truth.motion)[1][:, truth.subject.joints]
    local = np.einsum("tkba,tkb->tka", rotation, slide)
    assert np.mean(local[lag:] * local[:-lag]) / np.var(local) == pytest.approx(np.exp(-1), abs=0.05)
    noise = np.diff(local, 2, axis=0)  # what smooth sliding leaves: three samples' noise, 1 + 4 + 1 variances
    assert np.std(noise) / np.sqrt(6) == pytest.approx(0.0003, rel=0.1)


# The damage


@pytest.mark.parametrize("seed", range(4))
def test_damage_matches_its_masks(seed):
    truth = synthetic.compose_take(seed)
    np.testing.assert_array_equal(np.isnan(truth.damaged_positions).any(axis=2), truth.missing_mask)
    untouched = ~truth.missing_mask & ~truth.spike_mask
    np.testing.assert_array_equal(truth.damaged_positions[untouched], truth.marker_positions[untouched])
    assert not (truth.missing_mask & truth.spike_mask).any()
    jump = np.linalg.norm(truth.damaged_positions - truth.marker_positions, axis=2)[truth.spike_mask]
    assert len(jump) > 5
    assert jump.min() > 0.0299
    assert 0.02 < truth.missing_mask.mean() < 0.12
    lengths = [
        last - first + 1 for m in range(truth.missing_mask.shape[1]) for first, last in find_runs(truth.missing_mask[:, m])
    ]
    assert sum(length < 0.2 * RATE for length in lengths) >= 15
    assert sum(length >= 0.5 * RATE for length in lengths) >= 7 + 2  # the arm's, the late one, and others


def test_arm_gap_and_late_marker(truth):
    first, end = (round(second * RATE) for second in damage.ARM_GAP_S)
    assert 0 < damage.ARM_GAP_S[0] < damage.ARM_GAP_S[1] <= gestures.REACH_LEFT_TIMES_S[0]
    lost = {label for label, gone in zip(truth.labels, truth.missing_mask[first:end].all(axis=0), strict=True) if gone}
    assert lost >= {"LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN"}
    assert truth.missing_mask[: round(damage.LATE_START_S * RATE)].all(axis=0).sum() >= 1


def test_take_depends_on_the_seed_only():
    one, same, other = (synthetic.compose_take(seed, 2.0) for seed in (5, 5, 6))
    for field in fields(synthetic.SyntheticTake):
        if isinstance(value := getattr(one, field.name), np.ndarray):
            np.testing.assert_array_equal(value, getattr(same, field.name))
    assert np.abs(one.marker_positions - other.marker_positions).max() > 0.01
    assert (one.missing_mask != other.missing_mask).any()


@settings(max_examples=6)
@given(seconds=st.floats(0.1, 12), rate=st.floats(25, 300), seed=st.integers(0, 2**32))
def test_any_length_and_rate_gives_a_complete_body(seconds, rate, seed):
    truth = synthetic.compose_take(seed, seconds, rate)
    assert truth.damaged_positions.shape == (round(seconds * rate), len(truth.labels), 3)
    assert np.isfinite(truth.joint_positions).all()
    assert np.isfinite(truth.marker_positions).all()


# The file


def test_c3d_file_contains_the_take(truth, tmp_path):
    path = tmp_path / "walk.c3d"
    synthetic.write_synthetic_take(path, truth)
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    assert tuple(point["LABELS"]["value"]) == truth.labels
    assert (point["UNITS"]["value"], point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["mm"], ["+X"], ["+Z"])
    assert point["RATE"]["value"] == [RATE]
    header = file["header"]["points"]
    assert (header["first_frame"], header["last_frame"]) == (0, len(truth.damaged) - 1)  # counted from 0 by ezc3d
    xyz = file["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(xyz[..., [1, 2, 0]] / 1000, truth.damaged, atol=1e-6)  # NaN and all; 32-bit floats
    stored = np.frombuffer(path.read_bytes(), "<f4", truth.missing_mask.size * 4, (point["DATA_START"]["value"][0] - 1) * 512)
    np.testing.assert_array_equal(stored.reshape(-1, 4)[~truth.missing_mask.ravel(), 3], 0)  # measured, nothing filled
    np.testing.assert_array_equal(stored.reshape(-1, 4)[truth.missing_mask.ravel()], [[0, 0, 0, -1]] * truth.missing_mask.sum())


def test_c3d_file_is_read_back(truth, tmp_path):
    read = pytest.importorskip("mocapfix.read.capture")
    synthetic.write_synthetic_take(tmp_path / "walk.c3d", truth)
    take = read.take(tmp_path / "walk.c3d")
    assert (take.labels, take.rate, take.first_frame) == (truth.labels, RATE, 1)
    np.testing.assert_allclose(take.markers, truth.damaged, atol=1e-6)


def test_missing_folder_is_named(truth, tmp_path):
    with pytest.raises(WriteError, match="nowhere"):
        synthetic.write_synthetic_take(tmp_path / "nowhere" / "walk.c3d", truth)

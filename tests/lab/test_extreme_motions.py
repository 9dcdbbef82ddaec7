import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab.extreme_motions import (
    EXTREME_MOTIONS,
    STAND,
    WARM_UP,
    Move,
    build_keyed_motion,
    interpolate_key_poses,
    join_angles,
    measure_extremity_motion,
    mirror_pose,
    sample_angles,
    stretch_time,
)
from mocapfix.lab.stress import MAX_SOFT_TISSUE_LAG_M, compose_extreme_motion, compose_extreme_take
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.synthetic import draw_subject

RATE = 240.0
MAX_LIMIT_EXCESS_RAD = np.radians(20)  # kicks and splits go beyond the range of the database by 19 degrees
STRIKES = ("punch", "kick", "straight arm", "arm circle", "straight leg", "throw", "overhead swing")


@pytest.fixture(scope="module")
def subject():
    return draw_subject(np.random.default_rng(1), asymmetric=True)


@pytest.fixture(scope="module", params=EXTREME_MOTIONS)
def performed(request, subject):
    return request.param, compose_extreme_motion(subject, request.param, RATE)


def test_hands_and_feet_are_as_fast_as_in_sport(performed, subject):
    name, motion = performed
    speed, acceleration = measure_extremity_motion(subject, motion, RATE)
    assert speed == pytest.approx(EXTREME_MOTIONS[name].peak_speed_m_per_s, rel=0.08)
    if name in STRIKES:
        assert speed > 10
        assert 150 < acceleration < 300
    else:
        assert acceleration < 150


def test_angles_are_within_the_range_of_human_motion_and_smooth(performed, subject):
    _, motion = performed
    limits = load_joint_limits(subject.skeleton)
    deviation = motion.local_rotations @ limits.mean_rotations.swapaxes(-1, -2)
    vectors = Rotation.from_matrix(deviation.reshape(-1, 3, 3)).as_rotvec().reshape(*deviation.shape[:2], 3)
    excess = np.maximum(vectors - limits.upper_rad, limits.lower_rad - vectors)[:, 1:]
    assert excess.max() < MAX_LIMIT_EXCESS_RAD
    knees = [subject.skeleton.find_joint(name) for name in ("LeftLeg", "RightLeg")]
    bend = Rotation.from_matrix(motion.local_rotations[:, knees].reshape(-1, 3, 3)).magnitude()
    assert bend.max() < np.radians(135)
    steps = np.einsum("tjba,tjbc->tjac", motion.local_rotations[:-1], motion.local_rotations[1:])
    speed = Rotation.from_matrix(steps.reshape(-1, 3, 3)).magnitude() * RATE
    assert speed.max() < 45  # rad/s: an elbow in a throw reaches 40


def test_the_body_is_on_the_floor(performed, subject):
    _, motion = performed
    joints, _ = compute_world_poses(subject.skeleton, motion)
    lowest = joints[..., 1].min(axis=1)
    assert lowest.min() > 0
    assert lowest.max() < 0.25


def test_acrobatics_turn_the_body_over(subject):
    def up_of_hips(name):
        return compose_extreme_motion(subject, name, 60.0).local_rotations[:, 0, 1, 1]

    for name in ("cartwheel", "hand stand", "floor roll"):
        assert up_of_hips(name).min() < -0.95
    for name in (*STRIKES, "spin"):
        assert up_of_hips(name).min() > 0.6
    facing = compose_extreme_motion(subject, "spin", 60.0).local_rotations[:, 0, :, 2]
    heading = np.unwrap(np.arctan2(facing[:, 0], facing[:, 2]))
    assert np.ptp(heading) > 3 * 2 * np.pi  # three turns


def test_each_motion_is_done_on_both_sides(subject):
    joints, _ = compute_world_poses(subject.skeleton, compose_extreme_motion(subject, "throw", RATE))
    speeds = [
        np.linalg.norm(np.diff(joints[:, subject.skeleton.find_joint(f"{side}Hand")], axis=0), axis=1).max() * RATE
        for side in ("Left", "Right")
    ]
    assert min(speeds) > 9


def test_a_take_is_the_same_for_the_same_arguments_and_rates_show_the_same_motion():
    one, again = (compose_extreme_take("punch", seed=4, rate=60.0) for _ in range(2))
    np.testing.assert_array_equal(one.marker_positions, again.marker_positions)
    fast = compose_extreme_take("punch", seed=4, rate=240.0)
    assert abs(len(fast.joint_positions) - 4 * len(one.joint_positions)) <= 4
    count = min(len(fast.joint_positions[::4]), len(one.joint_positions))
    # the height of the hips is filtered at the frames of the take
    np.testing.assert_allclose(fast.joint_positions[::4][:count], one.joint_positions[:count], atol=0.005)


def test_gaps_are_optional_and_seen_samples_are_undamaged():
    whole, gaps = (compose_extreme_take("kick", seed=2, rate=60.0, with_gaps=with_gaps) for with_gaps in (False, True))
    assert not whole.missing_mask.any()
    assert 0.01 < gaps.missing_mask.mean() < 0.3
    assert not gaps.spike_mask.any()
    np.testing.assert_array_equal(np.isnan(gaps.damaged_positions[..., 0]), gaps.missing_mask)
    seen = ~gaps.missing_mask
    np.testing.assert_array_equal(gaps.damaged_positions[seen], whole.marker_positions[seen])


def test_soft_tissue_lags_behind_fast_motion():
    firm, soft = (compose_extreme_take("straight arm", seed=2, rate=120.0, with_soft_tissue=lag) for lag in (False, True))
    lag_m = np.linalg.norm(soft.marker_positions - firm.marker_positions, axis=-1)
    assert 0.012 < lag_m.max() <= MAX_SOFT_TISSUE_LAG_M
    assert np.median(lag_m) < 0.0005
    hand = firm.labels.index("RFIN")
    frame = int(lag_m[:, hand].argmax())
    acceleration = np.diff(firm.joint_positions[:, firm.subject.skeleton.find_joint("RightHand")], 2, axis=0)[frame - 1]
    displacement = (soft.marker_positions - firm.marker_positions)[frame, hand]
    assert displacement @ acceleration < -0.8 * np.linalg.norm(displacement) * np.linalg.norm(acceleration)


def test_slender_limbs_have_their_markers_nearer_to_the_bones():
    usual, slender = (
        compose_extreme_take("punch", 2, 60.0, with_slender_limbs=is_slender).subject for is_slender in (False, True)
    )
    elbow = usual.skeleton.offsets[usual.skeleton.find_joint("LeftForeArm")]
    k = usual.labels.index("LUPA")
    distances = [np.linalg.norm(np.cross(each.marker_offsets[k], elbow)) for each in (usual, slender)]
    assert distances[1] == pytest.approx(distances[0] / 2)
    assert usual.marker_offsets[k] @ elbow == pytest.approx(slender.marker_offsets[k] @ elbow)
    head = usual.labels.index("LFHD")
    np.testing.assert_array_equal(usual.marker_offsets[head], slender.marker_offsets[head])


def test_key_poses_are_reached_and_mirrored(subject):
    skeleton = subject.skeleton
    moves = (Move(0.5, {"LeftLeg": (-90, 0, 0)}), Move(0.5, {"LeftLeg": (-90, 0, 0)}), Move(0.5, STAND))
    keyed = interpolate_key_poses(skeleton, STAND, moves)
    motion = build_keyed_motion(subject, sample_angles(keyed, 100.0), 100.0)
    knee = Rotation.from_matrix(motion.local_rotations[:, skeleton.find_joint("LeftLeg")]).magnitude()
    assert np.degrees(knee.max()) == pytest.approx(90, abs=0.1)
    assert knee[0] == pytest.approx(0, abs=1e-6)
    assert mirror_pose({"LeftArm": (10, 20, 30), "Spine": (1, 2, 3)}) == {"RightArm": (10, 20, 30), "Spine": (1, -2, -3)}


def test_whole_turns_are_joined_without_a_jump(subject):
    turn = interpolate_key_poses(subject.skeleton, STAND, (Move(0.5, {**STAND, "Hips": (0, 0, 360)}),))
    joined = join_angles(stretch_time(turn, 2.0), turn)
    assert joined.duration_s == pytest.approx(3 * turn.duration_s, abs=0.005)
    assert np.abs(np.diff(joined.angles_deg, axis=0)).max() < 4
    assert joined.angles_deg[-1, 0, 2] == pytest.approx(720, abs=0.1)


def test_the_warm_up_moves_every_joint_that_markers_turn(subject):
    keyed = interpolate_key_poses(subject.skeleton, STAND, WARM_UP)
    ranges = np.ptp(keyed.angles_deg, axis=0).max(1)
    for name in ("LeftArm", "RightForeArm", "LeftUpLeg", "RightLeg", "LeftFoot", "Spine", "Neck"):
        assert ranges[subject.skeleton.find_joint(name)] > 20

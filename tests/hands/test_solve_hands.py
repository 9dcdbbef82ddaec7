"""Hands with known truth: recovered poses, gaps, deviations, and a body that does not move."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.fill.gap_estimates import estimate_missing_samples
from mocapfix.hands.calibrated_hand import minimise_hand_poses
from mocapfix.hands.calibration import calibrate_hand
from mocapfix.hands.finger_markers import find_finger_markers
from mocapfix.hands.hand_model import HAND_JOINTS, RAYS, TIP_JOINTS
from mocapfix.hands.solve_hands import HandMotion, add_palm_markers, solve_hand, solve_hands, trace_palm
from mocapfix.io.npz import write_npz
from mocapfix.model.motion import Motion
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.synthetic import compose_motion, draw_subject
from tests.hands.composed_hands import FRAMES, RATE_HZ, build_hand, carry_markers, compose_poses

LEFT_ARM = ("LeftArm", "LeftForeArm", "LeftHand")


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_a_hand_of_the_model_is_recovered(side):
    hand = build_hand(side)
    palm, poses = compose_poses(hand)
    markers = carry_markers(hand, poses)
    found = solve_hand(hand, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ)
    error = np.linalg.norm(found.point_positions - hand.compute_points(poses), axis=-1)
    assert error[:, len(HAND_JOINTS) :].mean() < 0.004
    assert error.mean() < 0.004
    assert found.joint_rotations.shape == (FRAMES, 15, 3, 3)
    assert (found.angles[:, 1::3, 2] > -0.3).all()  # nothing bends backwards
    assert found.is_seen.all()


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_a_lost_finger_marker_is_filled_from_the_hand_and_no_other_marker_changes(side):
    hand = build_hand(side, ("IDX3", "IDX6", "MID0"))
    palm, poses = compose_poses(hand)
    markers, truth = carry_markers(hand, poses), carry_markers(hand, poses)
    labels = list(hand.markers.markers.labels)
    lost, off_hand = slice(80, 170), 0.3 + markers[:, :1] + 0.05 * np.sin(np.arange(FRAMES) / 9)[:, None, None]
    index = labels.index(f"{side[0]}IDX3")
    markers[lost, index] = np.nan
    found = solve_hand(hand, markers, ~np.isnan(markers[..., 0]), palm, RATE_HZ)
    markers, truth = (np.concatenate([each, off_hand], axis=1) for each in (markers, truth))
    markers[100:140, -1] = np.nan
    carried = found.carry_markers(Take(markers, (*labels, "STICK"), RATE_HZ))
    assert np.linalg.norm(carried.marker_positions - truth[:, :-1], axis=-1).mean() < 0.004
    usual, filled = (next(estimate_missing_samples(markers, RATE_HZ, hands=hands)) for hands in ((), (carried,)))
    errors = [np.linalg.norm(each.position[lost, index] - truth[lost, index], axis=-1).mean() for each in (usual, filled)]
    assert errors[1] < 0.8 * errors[0]
    np.testing.assert_array_equal(usual.position[:, -1], filled.position[:, -1])
    np.testing.assert_array_equal(usual.sd[:, -1], filled.sd[:, -1])


def test_rotations_for_the_palms_axes_give_the_same_points():
    hand = build_hand("Right")
    palm, poses = compose_poses(hand)
    markers = carry_markers(hand, poses)
    found = solve_hand(hand, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ)
    rest = hand.model.skeleton.rest_positions
    tips, index = hand.model.skeleton.compute_rest_ends()[TIP_JOINTS], RAYS.index("Ring")
    position, rotation = found.palm_position, found.palm_rotation
    joints = HAND_JOINTS[3 * index : 3 * index + 3]
    for before, joint, after in zip([0, *joints[:2]], joints, [*joints[1:], None], strict=True):
        position = position + rotation @ (rest[joint] - rest[before])
        rotation = rotation @ found.joint_rotations[:, np.flatnonzero(joint == HAND_JOINTS)[0]]
        if after is None:
            position = position + rotation @ (tips[index] - rest[joint])
    np.testing.assert_allclose(position, found.tip_positions[:, index], atol=1e-9)


def test_the_npz_file_has_the_hands_above_the_floor(tmp_path):
    hand = build_hand("Left")
    palm, poses = compose_poses(hand)
    markers = carry_markers(hand, poses)
    found = solve_hand(hand, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ).lower_floor(0.5)
    write_npz(tmp_path / "hand.npz", Take(markers, hand.markers.markers.labels, RATE_HZ), hands=[found])
    with np.load(tmp_path / "hand.npz") as arrays:
        assert arrays["left_hand_names"].tolist()[:4] == [*(f"LeftHandThumb{n}" for n in (1, 2, 3)), "LeftHandIndex1"]
        assert arrays["left_hand_names"][-1] == "LeftHandPinkyTip"
        np.testing.assert_array_equal(arrays["left_hand_points"], found.point_positions)
        np.testing.assert_allclose(arrays["left_hand_points"][..., 1] + 0.5, hand.compute_points(poses)[..., 1], atol=0.02)
        assert arrays["left_hand_rotations"].shape == (FRAMES, 15, 4)
        assert not [name for name in arrays if name.startswith("right_hand")]


def test_a_lost_finger_follows_the_others_with_a_growing_deviation():
    hand = build_hand("Left", ["THM6", "IDX6", "MID6", "RNG6", "PNK6"])
    palm, poses = compose_poses(hand, seed=3)
    markers, middle = carry_markers(hand, poses), RAYS.index("Middle")
    is_used = np.ones(markers.shape[:2], bool)
    is_used[60:180, 2] = False
    found = solve_hand(hand, markers, is_used, palm, RATE_HZ)
    sd, tips = found.point_sd[:, 15 + middle], found.tip_positions[:, middle]
    assert sd[30] < sd[70] < sd[120]
    assert sd[30] < sd[170] < sd[120]
    assert sd[120] > 2 * sd[30]
    assert sd[120] < 0.06  # the neighbours' curl says more than nothing
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    assert steps.max() < 0.02  # nothing jumps at the edges of the gap
    error = np.linalg.norm(tips - hand.compute_points(poses)[:, 15 + middle], axis=1)
    assert (error[60:180] < 4 * np.sqrt(3) * sd[60:180]).all()
    assert not found.is_seen[60:180, middle].any()


def test_a_hand_without_visible_markers_is_at_rest_and_uncertain():
    hand = build_hand("Left", ["THM6", "IDX6"])
    palm, poses = compose_poses(hand)
    markers, is_used = carry_markers(hand, poses), np.ones((FRAMES, 2), bool)
    is_used[30:] = False
    found = solve_hand(hand, markers, is_used, palm, RATE_HZ)
    assert np.isfinite(found.point_positions).all()
    mean, _ = minimise_hand_poses(
        hand, hand.build_terms(markers[-1:], is_used[-1:], hand.track_palm(palm.select_frames(np.array([FRAMES - 1])))),
        (poses[0][-1:], poses[1][-1:]), (1.0,), 20,
    )  # fmt: skip
    assert np.linalg.norm(found.point_positions[-1] - hand.compute_points(mean)[0], axis=-1).max() < 0.03
    assert found.point_sd[-1, 15:].min() > 0.015


def test_noise_of_keypoints_does_not_shake_the_fingers():
    hand, rng = build_hand("Left", scheme="coco133-hands"), np.random.default_rng(3)
    palm, poses = compose_poses(hand, seed=4)
    points = carry_markers(hand, poses) + rng.normal(0, 0.004, (FRAMES, 21, 3))
    is_used = rng.random(points.shape[:2]) > 0.1
    found, true = solve_hand(hand, points, is_used, palm, RATE_HZ), hand.compute_points(poses)[:, 15:]
    assert np.linalg.norm(found.tip_positions - true, axis=2).mean() < 0.004
    shake, given = (np.sqrt((np.diff(each, 2, axis=0) ** 2).sum(-1).mean()) for each in (found.tip_positions, points))
    assert shake < np.sqrt((np.diff(true, 2, axis=0) ** 2).sum(-1).mean()) + 0.03 * given


@pytest.mark.parametrize("ratio", [0.92, 1.08])
def test_calibration_approaches_the_length_of_the_hand_and_says_how_well(ratio):
    hand = build_hand("Left")
    larger = replace(hand, model=hand.model.scale(np.full(20, ratio)), marker_offsets=hand.marker_offsets * ratio)
    palm, poses = compose_poses(larger, seed=2)
    markers = carry_markers(larger, poses) + np.random.default_rng(0).normal(0, 0.0005, (FRAMES, 10, 3))
    found = calibrate_hand(hand.markers, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ, 1.0)
    assert 0.1 < (found.length_m / hand.length_m - 1) / (ratio - 1) < 1.2
    assert (found.point_sd_m < 0.012).all()
    assert (found.point_sd_m > 0.001).all()
    solved = solve_hand(found, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ)
    error = (solved.point_positions - larger.compute_points(poses))[:, 15:]
    assert np.sqrt((error**2).mean()) < 2 * solved.point_sd[:, 15:].mean()


def compose_body(seconds=1.5):
    subject = draw_subject(np.random.default_rng(5), False, "frontwaist53")
    motion = compose_motion(subject, seconds, RATE_HZ)
    _, markers = compute_joint_and_marker_positions(subject, motion)
    return subject, replace(motion, joint_sd=np.full(motion.joint_sd.shape, 0.004)), markers


def test_fingers_do_not_move_the_body_and_other_sets_have_none():
    subject, motion, markers = compose_body()
    kept = Motion(*(np.copy(each) for each in vars(motion).values()))
    joint = subject.skeleton.find_joint("LeftHand")
    near = markers[:, subject.joints == joint].mean(1)[:, None] + [[0.05, -0.03, 0.0], [0.06, -0.03, 0.02]]
    take = Take(np.concatenate([markers, near], axis=1), (*subject.labels, "LIDX6", "LMID6"), RATE_HZ)
    (hand,) = solve_hands(take, take.visible, subject, motion)
    assert isinstance(hand, HandMotion)
    assert hand.hand.model.side == "Left"
    assert hand.hand.markers.markers.labels == ("LIDX6", "LMID6", "LIHAND", "LOHAND")
    for before, after in zip(vars(kept).values(), vars(motion).values(), strict=True):
        np.testing.assert_array_equal(before, after)
    assert solve_hands(Take(markers, subject.labels, RATE_HZ), np.ones(markers.shape[:2], bool), subject, motion) == ()
    assert solve_hands(take, take.visible, replace(subject, marker_set="cmu41"), motion) == ()
    is_used = take.visible.copy()
    is_used[:, -2:] = False
    assert solve_hands(take, is_used, subject, motion) == ()


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_the_wrist_stays_beside_the_markers_where_the_forearm_of_the_body_lies_beside_them(side):
    subject, rate, shift = draw_subject(np.random.default_rng(3), False, "frontwaist53"), 50.0, np.array([0.01, 0.03, -0.01])
    motion = compose_motion(subject, 1.0, rate)
    hands = find_finger_markers(subject.marker_set, (*subject.labels, *build_hand(side).markers.markers.labels))
    hand = next(each for each in hands if each.side == side)
    forearm, joint = (subject.skeleton.find_joint(f"{side}{name}") for name in ("ForeArm", "Hand"))
    local, skeleton = motion.local_rotations.copy(), subject.skeleton
    local[:, [forearm, joint]] = np.eye(3)
    offsets, places = skeleton.offsets.copy(), subject.marker_offsets.copy()
    offsets[forearm] += shift
    places[np.isin(subject.joints, [forearm, joint])] -= shift
    moved = replace(subject, skeleton=replace(skeleton, offsets=offsets), marker_offsets=places)
    motion = replace(motion, local_rotations=local)
    palms = [trace_palm(each, motion, side) for each in (subject, moved)]
    np.testing.assert_allclose(palms[1].position, palms[0].position, atol=1e-3)  # the size of the body changes with the offsets
    backs = [add_palm_markers(hand, each, subject.labels).markers.marker_offsets for each in (subject, moved)]
    np.testing.assert_allclose(backs[1], backs[0], atol=1e-3)


def test_fingers_without_a_forearm_are_not_solved():
    subject, motion, markers = compose_body(0.3)
    names = subject.skeleton.names
    arm = [label for label, joint in zip(subject.labels, subject.joints, strict=True) if names[joint] in LEFT_ARM]
    kept = subject.select_markers(set(subject.labels) - set(arm))
    assert not kept.solved_joints[names.index("LeftHand")]
    fingers = markers[:, [subject.labels.index("LIHAND"), subject.labels.index("RIHAND")]]
    take = Take(np.concatenate([markers, fingers], axis=1), (*subject.labels, "LIDX6", "RIDX6"), RATE_HZ)
    motion.joint_sd[:, ~kept.solved_joints] = np.nan
    hands = solve_hands(take, take.visible, kept, motion)
    assert [hand.hand.model.side for hand in hands] == ["Right"]

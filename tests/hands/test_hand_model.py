"""The hand against published anatomy, mirrored, and bent by single angles."""

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.hands import hand_model
from mocapfix.hands.hand_model import ANGLES, HAND_JOINTS, MIRROR, RAY_ROOTS, RAYS, TIP_JOINTS, load_hand
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.stats.rigid_alignment import compute_rotations

# Buryanov & Kotiuk 2010: proximal, middle and distal phalanx with the pulp (of the thumb metacarpal first), mm, and their SD
BONES_MM = {
    "Thumb": ((46.2, 31.6, 27.4), (3.9, 3.1, 1.6)),
    "Index": ((39.8, 22.4, 19.6), (4.9, 2.5, 2.3)),
    "Middle": ((44.6, 26.3, 21.4), (3.8, 3.0, 1.9)),
    "Ring": ((41.4, 25.7, 21.3), (3.9, 3.3, 2.2)),
    "Pinky": ((32.7, 18.1, 19.7), (2.8, 2.5, 2.5)),
}
METACARPALS_MM = {"Index": 68.1, "Middle": 64.6, "Ring": 58.0, "Pinky": 53.7}
CARPUS_MM = 32.0  # from the wrist's centre to the metacarpals


def pose_hand(hand, angles):
    """Return joints (15, 3) and tips (5, 3) with some angles, in degrees, by their names."""
    local = hand.skeleton.rest_rotations.copy()
    for joint in HAND_JOINTS:
        name = hand.skeleton.names[joint].removeprefix(f"{hand.side}Hand")
        own = np.array([np.radians(angles.get(f"{name}.{angle}", 0.0)) for angle in ANGLES])
        local[joint] = local[joint] @ compute_rotations(hand.compute_angles(own)[None])[0]
    position, rotation = compute_tree_poses(build_kinematic_tree(hand.skeleton), np.zeros((1, 3)), local[None])
    return position[0, HAND_JOINTS], (position[:, TIP_JOINTS] + (rotation[:, TIP_JOINTS] @ hand.tips[..., None])[..., 0])[0]


@pytest.mark.parametrize("ray", RAYS)
def test_lengths_are_those_of_x_rays(ray):
    hand, (lengths, spreads) = load_hand("Left"), BONES_MM[ray]
    joints = RAY_ROOTS[RAYS.index(ray)] + np.arange(1, 4)
    found = [*np.linalg.norm(hand.skeleton.offsets[joints[1:]], axis=1), np.linalg.norm(hand.skeleton.ends[joints[2]])]
    assert np.abs(1e3 * np.array(found) - lengths).max() < 0.1 * max(spreads)
    if ray != "Thumb":
        knuckle = 1e3 * np.linalg.norm(hand.skeleton.rest_positions[joints[0]])
        assert knuckle == pytest.approx(METACARPALS_MM[ray] + CARPUS_MM, rel=0.03)


def test_the_tip_of_the_middle_finger_is_a_hand_length_away():
    hand = load_hand("Right")
    assert hand.skeleton.compute_rest_ends()[TIP_JOINTS[2], 0] == pytest.approx(-hand.length_m, rel=0.01)


@pytest.mark.parametrize("ray", RAYS)
def test_right_hands_are_the_mirror_images_of_left_ones(ray):
    angles = {f"{ray}1.flexion": 40, f"{ray}1.abduction": 10, f"{ray}1.twist": 5, f"{ray}2.flexion": 50, f"{ray}3.flexion": 30}
    left, right = (np.concatenate(pose_hand(load_hand(side), angles)) for side in ("Left", "Right"))
    np.testing.assert_allclose(right, left * MIRROR, atol=1e-12)
    priors = [load_hand(side).prior for side in ("Left", "Right")]
    np.testing.assert_allclose(priors[1].mean_vectors, priors[0].mean_vectors * -MIRROR)
    np.testing.assert_allclose(priors[1].components, priors[0].components * -MIRROR)


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize("ray", RAYS[1:])
def test_flexion_brings_the_tip_below_the_palm_and_abduction_to_the_thumb(side, ray):
    hand, finger = load_hand(side), RAYS.index(ray)
    _, straight = pose_hand(hand, {})
    _, bent = pose_hand(hand, {f"{ray}1.flexion": 60})
    _, spread = pose_hand(hand, {f"{ray}1.abduction": 10})
    assert bent[finger, 1] < straight[finger, 1] - 0.04  # y points out of the back of the hand
    assert spread[finger, 2] > straight[finger, 2] + 0.01
    np.testing.assert_allclose(np.delete(bent, finger, axis=0), np.delete(straight, finger, axis=0))


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_the_thumb_opposes_the_fingers(side):
    hand = load_hand(side)
    pinch = {"Thumb1.abduction": 25, "Thumb1.flexion": 20, "Thumb2.flexion": 25, "Thumb3.flexion": 15}
    pinch |= {"Index1.flexion": 45, "Index2.flexion": 50, "Index3.flexion": 25}
    straight, pinched = pose_hand(hand, {})[1], pose_hand(hand, pinch)[1]
    assert np.linalg.norm(pinched[0] - pinched[1]) < 0.4 * np.linalg.norm(straight[0] - straight[1])
    assert pinched[0, 1] < straight[0, 1] - 0.02


def test_closed_fingers_converge():
    angles = {f"{ray}{joint}.flexion": 80 for ray in RAYS[1:] for joint in (1, 2)}
    tips, closed = (pose_hand(load_hand("Left"), each)[1][1:, 2] for each in ({}, angles))
    assert closed.max() - closed.min() < 0.8 * (tips.max() - tips.min())


def test_ranges_contain_the_mean_pose_and_those_of_left_and_right_agree():
    left, right = load_hand("Left"), load_hand("Right")
    low, high = left.limits.lower_rad, left.limits.upper_rad
    assert ((low <= left.prior.mean_vectors) & (left.prior.mean_vectors <= high)).all()
    joint = left.skeleton.find_joint("LeftHandIndex2")
    assert np.degrees(left.compute_angles(np.stack([low[joint], high[joint]]))[:, 2]).tolist() == pytest.approx([110, -5])
    np.testing.assert_allclose(right.limits.lower_rad[..., 0], low[..., 0])
    np.testing.assert_allclose(right.limits.lower_rad[..., 1:], -high[..., 1:])


def test_end_joints_follow_by_two_thirds_in_every_mode():
    components = load_hand("Left").prior.components[..., ANGLES.index("flexion")]
    for root in RAY_ROOTS[1:]:
        np.testing.assert_allclose(components[:, root + 3], 0.667 * components[:, root + 2])


def test_fingers_bend_together_and_the_spread_of_angles_is_that_of_people():
    prior, axis = load_hand("Left").prior, ANGLES.index("flexion")
    flat = prior.components[..., axis][:, HAND_JOINTS]
    covariance = flat.T @ flat + np.diag(prior.axis_sd_rad[HAND_JOINTS, axis] ** 2)
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    knuckles, middles, ends = (slice(3 + n, None, 3) for n in range(3))
    assert ((np.degrees(sd[knuckles]) > 20) & (np.degrees(sd[knuckles]) < 32)).all()
    assert ((np.degrees(sd[ends]) > 15) & (np.degrees(sd[ends]) < 28)).all()
    assert correlation[3, 6] > correlation[3, 12] > 0.3  # the index goes more with the middle finger than with the little one
    assert (np.diag(correlation[middles, ends]) > 0.7).all()
    assert (correlation[0:3, 3:] >= -1e-12).all()


def test_a_take_has_the_variance_of_all_takes_less_that_of_their_means():
    prior = load_hand("Left").prior
    within = prior.condition_on_take(np.zeros(prior.code_size), np.zeros(prior.mean_vectors.shape))
    between = (1 - prior.within_share) * (prior.components**2).sum(0)
    np.testing.assert_allclose((within.components**2).sum(0) + between, (prior.components**2).sum(0))
    moved = prior.condition_on_take(np.eye(prior.code_size)[0], np.zeros(prior.mean_vectors.shape))
    assert np.abs(moved.mean_vectors - prior.mean_vectors).max() > 0.1


@pytest.mark.parametrize("broken", ["rays: {}", "angles: {Index9.flexion: {mean: 0, range: [0, 1], sd: 1}}"])
def test_a_broken_file_is_named(broken, tmp_path, monkeypatch):
    shipped = (hand_model.find_shipped_folder("priors") / "hand.yaml").read_text(encoding="utf-8")
    (tmp_path / "hand.yaml").write_text(f"{shipped}\n{broken}\n", encoding="utf-8")
    monkeypatch.setattr(hand_model, "find_shipped_folder", lambda name: tmp_path)
    load_hand.cache_clear()
    with pytest.raises(SceneError, match=r"hand\.yaml: (rays|angles): is incomplete"):
        load_hand("Left")
    load_hand.cache_clear()

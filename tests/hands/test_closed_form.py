"""Poses of hands in closed form: exact points, noise, and what no point shows."""

import numpy as np
import pytest

from mocapfix.hands import calibrated_hand
from mocapfix.hands.calibrated_hand import PalmPath
from mocapfix.hands.hand_model import HAND_JOINTS, RAY_ROOTS, load_hand
from mocapfix.hands.solve_hands import pose_in_closed_form, predict_saddle_twist
from mocapfix.stats.rigid_alignment import compute_rotation_vectors, compute_rotations
from tests.hands.composed_hands import FRAMES, build_hand, carry_markers, compose_poses


def pose_keypoints(side, twist_rad=0.0, noise_m=0.0):
    """Return a hand with keypoints, true poses of hinges without twist, and points with uniform noise along each axis."""
    hand, rng = build_hand(side, scheme="coco133-hands"), np.random.default_rng(4)
    palm, (root, local) = compose_poses(hand, seed=1)
    angles = hand.model.compute_angles(compute_rotation_vectors(local[:, HAND_JOINTS]))
    angles[..., 0] = 0
    angles[:, 0, 0] = twist_rad
    local[:, HAND_JOINTS] = compute_rotations(hand.model.compute_angles(angles))
    points = carry_markers(hand, (root, local))
    return hand, palm, (root, local), points + rng.uniform(-noise_m, noise_m, points.shape)


def know_nothing_of(palm):
    return PalmPath(0 * palm.position, *np.tile(np.eye(3), (2, FRAMES, 1, 1)), *np.full((2, FRAMES), 1e3))


@pytest.mark.parametrize("variant", ["naive", "adaptive"])
@pytest.mark.parametrize("side", ["Left", "Right"])
def test_exact_points_are_met_and_hinges_turn_as_they_did(side, variant):
    hand, palm, poses, points = pose_keypoints(side)
    found = pose_in_closed_form(hand, points, know_nothing_of(palm), variant)
    np.testing.assert_allclose(hand.compute_points(found), hand.compute_points(poses), atol=1e-6)
    fingers = HAND_JOINTS[3:]
    np.testing.assert_allclose(found[1][:, fingers], poses[1][:, fingers], atol=2e-2)  # knuckles keep what is left of a twist


@pytest.mark.parametrize("noise_m", [0.005, 0.010])
def test_adaptive_tips_are_nearer_than_naive_ones(noise_m):
    hand, palm, poses, points = pose_keypoints("Left", noise_m=noise_m)
    true = hand.compute_points(poses)[:, 15:]
    naive, adaptive = (
        np.linalg.norm(hand.compute_points(pose_in_closed_form(hand, points, know_nothing_of(palm), each))[:, 15:] - true, axis=2)
        for each in ("naive", "adaptive")
    )
    assert adaptive.mean() < 0.85 * naive.mean()


def test_a_hinge_shows_the_twist_of_the_joint_before_it(monkeypatch):
    monkeypatch.setattr(calibrated_hand, "MARKER_SD_M", 0.0003)  # the prior outweighs less certain points
    errors = []
    for with_points_beyond in (True, False):
        hand, palm, poses, points = pose_keypoints("Left", twist_rad=0.3)
        if not with_points_beyond:
            points[:, [3, 4]] = np.nan  # of the thumb
        found = pose_in_closed_form(hand, points, know_nothing_of(palm))
        thumb = RAY_ROOTS[0] + 1
        turn = compute_rotation_vectors(found[1][:, thumb].swapaxes(-1, -2) @ poses[1][:, thumb])
        errors.append(np.linalg.norm(turn, axis=1).mean())
    assert errors[0] < 0.8 * errors[1]


def test_a_thumb_that_opposes_pronates_on_both_hands():
    for side, mirrored in (("Left", 1), ("Right", -1)):
        model = load_hand(side)
        turns = np.array([[0, 0, 0], [0, -0.4, 0], [0, 0.4, 0]]) * mirrored  # abduction of a left hand turns about -y
        along = model.skeleton.offsets[RAY_ROOTS[0] + 2]
        cosine, sine = predict_saddle_twist(model, compute_rotations(turns) @ along).T
        rest, opposed, adducted = np.arctan2(sine, cosine)
        assert rest == pytest.approx(0, abs=1e-9)
        assert opposed == pytest.approx(-adducted)
        assert opposed * mirrored > 0.1  # about the bone
        unknown = predict_saddle_twist(model, np.full((1, 3), np.nan))
        np.testing.assert_allclose(unknown[0, 1], 0, atol=1e-9)


def test_fingers_without_points_have_the_mean_pose_and_a_hand_without_points_the_palm_of_the_body():
    hand, palm, _, points = pose_keypoints("Right")
    points[: FRAMES // 2] = np.nan
    points[FRAMES // 2 :, 9:13] = np.nan  # the middle finger
    root, local = pose_in_closed_form(hand, points, palm)
    mean = compute_rotations(hand.model.prior.mean_vectors[HAND_JOINTS])
    np.testing.assert_allclose(local[: FRAMES // 2, HAND_JOINTS], np.tile(mean, (FRAMES // 2, 1, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(local[FRAMES // 2 :, HAND_JOINTS[6:9]], np.tile(mean[6:9], (FRAMES // 2, 1, 1, 1)), atol=1e-9)
    placed_root, placed = hand.place_palm(palm)
    np.testing.assert_allclose(root[: FRAMES // 2], placed_root[: FRAMES // 2], atol=1e-9)
    np.testing.assert_allclose(local[: FRAMES // 2, 0], placed[: FRAMES // 2, 0], atol=1e-9)
    assert np.isfinite(hand.compute_points((root, local))).all()

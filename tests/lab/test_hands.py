"""The composed hands of the benchmark."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.load_character import load_character
from mocapfix.errors import SceneError
from mocapfix.lab import hands


@pytest.fixture(scope="module")
def composed():
    return hands.compose_hands(0)


def test_hands_are_at_the_wrists_and_bend_as_hands_do(composed):
    for side, hand in composed.hands.items():
        thumb, index = (np.linalg.norm(np.diff(hand.points[:, joints], axis=1), axis=-1) for joints in ([1, 2], [4, 5]))
        assert np.ptp(thumb, axis=0).max() < 1e-9  # bones keep their lengths
        assert np.ptp(index, axis=0).max() < 1e-9
        marker = composed.take.labels.index(f"{side[0]}IHAND")
        distance = np.linalg.norm(hand.points[:, 3] - composed.take.markers[:, marker], axis=-1)
        assert np.nanmax(distance) < 0.12
        assert np.degrees(hand.flexions).max() < 130
        ratio = hand.flexions[:, 5] / np.maximum(hand.flexions[:, 4], 0.1)
        assert 0.3 < np.median(ratio) < 1.0


def test_gaps_are_as_frequent_and_as_long_as_in_productions():
    rng, labels = np.random.default_rng(0), ("LIDX3", "LIDX6", "LMID0")
    missing = np.mean([hands.draw_finger_gaps(rng, 6000, labels).mean(0) for _ in range(20)], axis=0)
    assert missing[1] == pytest.approx(0.035, abs=0.01)
    assert missing[1] > missing[0]


def test_columns_of_fewer_markers_keep_those_of_the_body(composed):
    labels = composed.take.labels
    kept = {labels[column] for column in hands.select_columns(composed, labels, hands.MARKER_COUNTS[6])}
    assert set(labels) - kept == {f"{side}{name}" for side in "LR" for name in (
        "THM6", "IDX6", "MID0", "MID6", "RNG3", "RNG6", "PNK6"
    )}  # fmt: skip


def test_markers_on_the_back_of_a_hand_keep_their_places_on_it(composed):
    for side, hand in composed.hands.items():
        marker = composed.take.markers[:, composed.take.labels.index(f"{side[0]}OHAND")]
        for knuckle in (3, 6, 9, 12):  # they slide on the skin by 4 mm per axis
            assert np.nanstd(np.linalg.norm(hand.points[:, knuckle] - marker, axis=-1)) < 0.008


def test_fills_are_compared_with_a_line_a_cubic_and_a_palm_that_carries_the_marker(composed):
    hand, take = composed.hands["Left"], composed.take
    perfect = take.markers.copy()
    columns = [take.labels.index(label) for label in hand.labels]
    perfect[:, columns] = hand.markers
    rows = hands.compare_fills(hand, take, replace(take, markers=perfect))
    assert {name for name, found in rows.items() if found} == set(hands.FILL_LENGTHS)
    errors = np.concatenate([each for found in rows.values() for each in found])
    assert (errors[:, 0] == 0).all()
    assert errors[:, 3].mean() < 0.5 * errors[:, 1].mean()  # of a marker that moves with the palm, and of a line


def test_keypoints_are_the_joints_with_noise():
    truth = hands.compose_keypoints(0)
    labels, missing = truth.take.labels, ~truth.take.visible
    assert truth.take.rate == pytest.approx(hands.HAND_RATE_HZ / hands.KEYPOINT_STEP)
    assert sum("finger" in label or "thumb" in label or "hand_root" in label for label in labels) == 42
    assert missing.mean() == pytest.approx(hands.LOST_KEYPOINT_SHARE, abs=0.01)
    for label, point in (("right_middle_finger4", 17), ("right_thumb1", 0), ("right_forefinger3", 5)):
        error = truth.take.markers[:, labels.index(label)] - truth.hands["Right"].points[:, point]
        assert np.nanstd(error) == pytest.approx(hands.HAND_KEYPOINT_SD_M, rel=0.1)
        assert np.abs(np.nanmean(error, axis=0)).max() < 0.001


def test_jitter_is_what_tips_do_in_the_palm():
    rng, frames = np.random.default_rng(0), 5000
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 9, frames), [0, 1, 0])).as_matrix()
    root, still = rng.normal(size=(frames, 3)), np.ones((frames, 5, 3))
    noise = rng.normal(0, 0.01, still.shape)
    in_world = [root[:, None] + np.einsum("tab,tkb->tka", turns, each) for each in (still, still + noise)]
    assert hands.measure_jitter(in_world[0], (root, turns)) == pytest.approx(0, abs=1e-12)
    assert hands.measure_jitter(in_world[1], (root, turns)) == pytest.approx(0.01 * np.sqrt(3 * 6), rel=0.02)


def test_adaptive_fingers_are_nearer_than_naive_ones():
    errors = hands.measure_finger_noise()
    assert max(errors["0"].values()) < 1e-3
    for noise in ("5", "10"):
        assert errors[noise]["adaptive"] < 0.85 * errors[noise]["naive"]


@pytest.mark.parametrize("side", hands.SIDES)
def test_the_hand_of_a_rig_with_the_bones_of_the_model_is_the_model(side):
    found, model = hands.read_rig_hands(Path("smplx"))[side], hands.load_hand(side)  # on a forearm that slopes by 1 degree
    np.testing.assert_allclose(found.model.skeleton.compute_rest_ends(), model.skeleton.compute_rest_ends(), atol=0.005)
    np.testing.assert_allclose(found.model.skeleton.rest_positions, model.skeleton.rest_positions, atol=0.005)
    np.testing.assert_allclose(found.flexions, 0.0, atol=0.08)


def test_people_with_the_hands_of_a_rig_have_its_proportions():
    rig = hands.read_rig_hands(Path("mixamo"))
    positions = load_character("mixamo").skeleton
    for side, hand in hands.compose_hands(0, rig=rig).hands.items():
        names = [f"mixamorig:{side}HandMiddle{number}" for number in (1, 2, 3, 4)]
        own = np.linalg.norm(np.diff(positions.rest_positions[[positions.find_joint(name) for name in names]], axis=0), axis=1)
        found = np.linalg.norm(np.diff(hand.points[:, [6, 7, 8, 17]], axis=1), axis=2)
        np.testing.assert_allclose(found / found[:, :1], np.broadcast_to(own / own[0], found.shape), atol=1e-6)


def test_a_rig_without_fingers_is_refused():
    with pytest.raises(SceneError, match="thumb of the left hand needs three bones"):
        hands.read_rig_hands(Path("smpl"))

"""Which finger markers a take has, by the scheme of its marker set."""

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.hands.finger_markers import find_finger_markers, list_finger_sets, load_finger_schemes, read_finger_scheme
from mocapfix.hands.hand_model import MIRROR, load_hand
from mocapfix.subject.library import choose_marker_set, load_marker_set

VICON = tuple(f"{side}{name}" for side in "LR" for name in (
    "THM3", "THM6", "IDX3", "IDX6", "MID0", "MID6", "RNG3", "RNG6", "PNK3", "PNK6"
))  # fmt: skip
FIVE = tuple(label for label in VICON if label.endswith("6"))
THREE = ("RIDX3", "LPNK3", "LIDX3", "RTHM3", "LTHM3", "RPNK3")  # in the order of the files
OPTITRACK = ("LThumb", "LIndex", "LPinky", "RThumb", "RIndex", "RPinky")


@pytest.mark.parametrize("body", ["frontwaist53", "production57"])
@pytest.mark.parametrize(("fingers", "count"), [(VICON, 10), (FIVE, 5), (THREE, 3)])
def test_sets_of_vicon_are_found_with_their_body(body, fingers, count):
    labels = tuple(f"Jim:{label}" for label in (*fingers, *load_marker_set(body).labels))
    chosen = choose_marker_set(labels).marker_set
    assert chosen is not None
    assert chosen.name == body  # the body's set is the same with fingers
    left, right = find_finger_markers(body, labels)
    assert (left.side, right.side) == ("Left", "Right")
    for hand in (left, right):
        assert len(hand.columns) == count
        assert [labels[column].removeprefix("Jim:") for column in hand.columns] == list(hand.markers.labels)


def test_sets_of_optitrack_are_found_with_their_body():
    left, right = find_finger_markers("optitrack-core50", (*load_marker_set("optitrack-core50").labels, *OPTITRACK))
    assert left.markers.labels == ("LThumb", "LIndex", "LPinky")
    assert right.columns.tolist() == [53, 54, 55]


def test_sets_of_qualisys_are_found_with_their_body():
    tips = ("LThumbTip", "LIndexTip", "LPinkyTip")
    (left,) = find_finger_markers("qualisys-animation", (*load_marker_set("qualisys-animation").labels, *tips))
    assert left.markers.labels == tips
    assert [len(hand.markers.labels) for hand, _ in list_finger_sets("qualisys-animation")] == [3, 5, 10]


def test_of_two_schemes_with_the_same_names_that_with_more_of_the_labels_is_used():
    dense = next(each for each in load_finger_schemes() if each.name == "moshpp-fingers")
    for labels, name in ((dense.hands[0].labels, "moshpp-fingers"), (VICON, "vicon-fingers"), (THREE, "vicon-fingers")):
        assert {hand.markers.name for hand in find_finger_markers("production57", labels)} == {name}


@pytest.mark.parametrize(("body", "wrist", "tip"), [
    ("coco133", "left_hand_root", "left_pinky_finger4"), ("mediapipe33", "left_hand_wrist", "left_hand_pinky_tip"),
])  # fmt: skip
def test_keypoints_of_hands_are_found_with_their_body(body, wrist, tip):
    scheme = next(each for each in load_finger_schemes() if body in each.marker_sets)
    labels = (*load_marker_set(body).labels, *scheme.hands[0].labels, *scheme.hands[1].labels)
    left, right = find_finger_markers(body, labels)
    assert len(left.columns) == len(right.columns) == 21
    assert left.markers.point_sd == 0.008
    joints = dict(zip(left.markers.labels, left.turning_joints.tolist(), strict=True))
    names = load_hand("Left").skeleton.names
    assert joints[wrist] == 0
    assert names[joints[tip]] == "LeftHandPinky3"
    assert sum(joint == 0 for joint in joints.values()) == 6  # wrist, knuckles, saddle joint
    assert [label.replace("left", "right") for label in left.markers.labels] == list(right.markers.labels)


def test_both_spellings_of_mediapipes_fingers_are_known():
    labels = ("left_hand_index_mcp", "left_hand_index_tip", "left_hand_pinky_finger_tip")
    (left,) = find_finger_markers("mediapipe33", labels)
    assert left.columns.tolist() == [0, 1, 2]
    assert left.markers.labels == ("left_hand_index_finger_mcp", "left_hand_index_finger_tip", "left_hand_pinky_tip")


def test_knuckles_alone_are_no_hand():
    assert find_finger_markers("coco133", load_marker_set("coco133").labels) == ()


@pytest.mark.parametrize("body", ["cmu41", "coco133", "a set of one's own"])
def test_a_label_means_nothing_in_another_scheme(body):
    assert find_finger_markers(body, VICON) == ()
    assert find_finger_markers("optitrack-core50", VICON) == ()
    assert find_finger_markers("frontwaist53", OPTITRACK) == ()


def test_a_hand_without_markers_is_left_out():
    (only,) = find_finger_markers("frontwaist53", ("RIDX3", "LFHD", "RTHM3"))
    assert only.side == "Right"
    assert only.markers.labels == ("RTHM3", "RIDX3")
    assert only.columns.tolist() == [2, 0]


def test_places_are_on_the_segments_they_name_and_mirrored():
    scheme = next(each for each in load_finger_schemes() if each.name == "vicon-fingers")
    left, right = scheme.hands
    names = [load_hand("Left").skeleton.names[joint] for joint in left.joints]
    assert dict(zip(left.labels, names, strict=True)) == {
        "LTHM3": "LeftHandThumb2", "LTHM6": "LeftHandThumb3", "LIDX3": "LeftHandIndex2", "LIDX6": "LeftHandIndex3",
        "LMID0": "LeftHandMiddle1", "LMID6": "LeftHandMiddle3", "LRNG3": "LeftHandRing2", "LRNG6": "LeftHandRing3",
        "LPNK3": "LeftHandPinky2", "LPNK6": "LeftHandPinky3",
    }  # fmt: skip
    np.testing.assert_array_equal(right.joints, left.joints)
    np.testing.assert_array_equal(right.marker_offsets, left.marker_offsets * MIRROR)
    lengths = np.abs([load_hand("Left").skeleton.ends[joint, 0] for joint in left.joints])
    assert not (left.marker_offsets[:, 0] > lengths).any()  # tips are beyond their markers; NaN for other segments


@pytest.mark.parametrize("problem", ["marker_sets: 3", "markers: {RIDX3: {}}", "markers: {LIDX3: {joint: Toe}}", "markers: 1"])
def test_a_broken_scheme_is_named(problem, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"name: mine\ntitle: mine\nmarker_sets: [a]\nmarkers: {{}}\n{problem}\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"mine\.yaml: must hold name"):
        read_finger_scheme(path)

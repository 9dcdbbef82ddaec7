"""Locating markers by the words in their labels."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.label_words import guess_marker_set_from_words, locate_label, names_object
from mocapfix.subject.library import load_marker_set
from tests.subject.test_shipped_sets import WHOLE_BODY_SETS

EACH = pytest.mark.parametrize("marker_set", [load_marker_set(name) for name in WHOLE_BODY_SETS], ids=lambda each: each.name)
NEAR = {"Hips": ("LeftUpLeg", "RightUpLeg"), "Spine1": ("LeftShoulder", "RightShoulder")}


@EACH
def test_labels_of_shipped_sets_locate_their_segments(marker_set):
    names, correct_count = load_cmu31_body().skeleton.names, 0
    for label, joint in zip(marker_set.labels, marker_set.joints, strict=True):
        if location := locate_label(label):
            assert location[0] == names[joint] or location[0] in NEAR.get(names[joint], ()), label
            correct_count += 1
    assert correct_count >= 0.75 * len(marker_set.labels)


@pytest.mark.parametrize(
    ("label", "joint"),
    [
        ("LKNE", "LeftUpLeg"), ("R_Knee_Lat", "RightUpLeg"), ("linksKnie", "LeftUpLeg"), ("genou droit", "RightUpLeg"),
        ("Knie_rechts", "RightUpLeg"), ("cheville_gauche", "LeftLeg"), ("L_FM1", "LeftFoot"), ("ASISr", "Hips"),
        ("LTH3", "LeftUpLeg"), ("LTHLP", None), ("KNE", None), ("C7", "Spine1"), ("C71", None), ("STRN", "Spine1"),
        ("Stick 1", None), ("Puck", None), ("*12", None), ("P12", None), ("RShinFrontHigh", "RightLeg"), ("LAJC", None),
        ("Left Shoulder", "LeftShoulder"), ("RFIN", "RightHand"), ("Head", None), ("HeadFront", "Head"), ("L.Heel", "LeftFoot"),
    ],
)  # fmt: skip
def test_words_and_sides(label, joint):
    location = locate_label(label)
    assert (location and location[0]) == joint


@pytest.mark.parametrize(
    "label",
    [
        "WheelchairL",
        "R.Wheel",
        "Handrim_R",
        "L.Handle",
        "Racket:1",
        "Bat1",
        "Boite_gauche_ext",
        "Footplate_L",
        "LWheels",
        "R.Roue",
    ],
)
def test_objects_are_no_body_markers(label):
    assert names_object(label)
    assert locate_label(label) is None


@pytest.mark.parametrize(
    ("label", "joint"),
    [
        ("L.Medial.Knee", "LeftUpLeg"), ("Medial_Knee_L", "LeftUpLeg"), ("INNERKNEEL", "LeftUpLeg"), ("R.Calf", "RightLeg"),
        ("LShoe", "LeftFoot"), ("L.Post.Fem.", "LeftUpLeg"), ("R.Ant.Tib.", "RightLeg"), ("L.HeadHum", "LeftArm"),
        ("Rear", None), ("Medial", None), ("L.D5M1", None), ("Small_L", None), ("LHelmet", "Head"),
    ],
)  # fmt: skip
def test_words_begin_where_a_label_or_one_of_its_words_does(label, joint):
    assert not names_object(label)
    location = locate_label(label)
    assert (location and location[0]) == joint


@pytest.mark.parametrize(
    ("labels", "located"),
    [
        (("ASISr", "ASISl", "ARMl", "ARMm", "LARMm"), ("ASISr", "ASISl")),
        (("LASI", "RASI", "LARM", "KNEL"), ("LASI", "RASI", "LARM")),
        (("LSHO", "LELB"), ("LSHO", "LELB")),
    ],
    ids=["lateral and lower", "another place", "one arm"],
)
def test_a_letter_for_a_side_stands_where_it_does_in_pairs(labels, located):
    assert guess_marker_set_from_words(labels).labels == located


@pytest.mark.parametrize("word", ["KNE", "ELB", "WRA", "FWT", "TOE", "FHD"])
def test_right_mirrors_left(word):
    on_left, on_right = locate_label(f"L{word}"), locate_label(f"R{word}")
    assert on_left is not None
    assert on_right is not None
    (left, place), (right, other) = on_left, on_right
    assert right == left.replace("Left", "Right")
    np.testing.assert_array_equal(other, place * [-1, 1, 1])
    assert (place[0] > 0) == (load_marker_set("cmu41").marker_offsets[load_marker_set("cmu41").labels.index("L" + word)][0] > 0)


def test_guess_contains_located_markers_only():
    guess = guess_marker_set_from_words(["LKNE", "Puck", "RKNE", "C7"])
    assert guess.labels == ("LKNE", "RKNE", "C7")
    assert [load_cmu31_body().skeleton.names[j] for j in guess.joints] == ["LeftUpLeg", "RightUpLeg", "Spine1"]
    assert guess_marker_set_from_words(["Puck"]).marker_offsets.shape == (0, 3)

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.io import capture
from mocapfix.io.coordinates import (
    AXIS_NAMES,
    METRES_PER_UNIT,
    ROTATIONS_TO_Y_UP,
    InspectedPoints,
    classify_label_height,
    collect_body_evidence,
    estimate_up_axis,
    find_free_fall,
    get_metres_per_unit,
    sample_points,
    split_subjects_off,
)
from mocapfix.options import ReadOptions
from mocapfix.report.notes import describe_up_axis
from tests.c3d_files import c3d_bytes


@pytest.mark.parametrize(
    ("name", "unit"),
    [("mete", "m"), ("mill", "mm"), ("milli", "mm"), ("Centim", "cm"), ("inch", "in"), ("Inches", "in"), ("foot", "ft"),
     ("METRES ", "m"), ("mm", "mm"), ("MM.", "mm")],
)  # fmt: skip
def test_a_name_of_a_unit_may_be_cut_off(name, unit):
    assert get_metres_per_unit(name) == METRES_PER_UNIT[unit]


@given(st.text(max_size=12))
def test_other_texts_are_no_unit(text):
    known = ("mm", "cm", "m", "in", "ft", "mil", "cen", "met", "mtr", "inc", "foo", "fee")
    if not text.strip().lower().startswith(known):
        assert get_metres_per_unit(text) is None


@pytest.mark.parametrize("name", ["me", "mi", "furlong", "metric", "inchworm", ""])
def test_a_name_that_is_too_short_or_goes_on_otherwise_is_no_unit(name):
    assert get_metres_per_unit(name) is None


RATE = 60.0
LABELS = (
    "LFHD",
    "RFHD",
    "LSHO",
    "RSHO",
    "LASI",
    "RASI",
    "LPSI",
    "RPSI",
    "LKNE",
    "RKNE",
    "LANK",
    "RANK",
    "LHEE",
    "RHEE",
    "LTOE",
    "RTOE",
)
# A person who stands in metres, Y up, facing +Z.
LEFT_SIDE = [[0.08, 1.65, 0.1], [0.2, 1.4, 0], [0.13, 0.98, 0.1], [0.05, 0.98, -0.1]]
LEFT_SIDE += [[0.15, 0.5, 0.02], [0.13, 0.09, 0], [0.1, 0.05, -0.07], [0.12, 0.04, 0.15]]
PERSON = np.array(LEFT_SIDE)
PERSON = np.stack([PERSON, PERSON * [-1, 1, 1]], axis=1).reshape(-1, 3)
LEGS = [m for m, label in enumerate(LABELS) if label[1:] not in ("FHD", "SHO")]
PRONE = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
SUPINE = PRONE.T


def build_motion(person=PERSON, place=(0.6, 0.0, 0.9)):
    """Return 4 s of a person who moves every part by some centimetres."""
    time = np.arange(240)[:, None, None] / RATE
    phase = np.random.default_rng(2).uniform(0, 6, size=(1, *person.shape))
    return person + 0.02 * np.sin(2 * time + phase) + np.array(place)


def walk():
    """Return a walk of 3 m along X."""
    turned = PERSON[:, [2, 1, 0]] * [1, 1, -1]
    motion = build_motion(turned, (-1.5, 0.0, -0.4))
    motion[..., 0] += np.linspace(0, 3, len(motion))[:, None]
    return motion


def lie(turn):
    """Return a person who lies on the floor."""
    person = PERSON @ turn.T
    return build_motion(person - [0, person[:, 1].min() - 0.05, 0], (0.6, 0.0, 0.9))


def build_points(labels, positions_file, rate=RATE):
    """Return positions in file axes as the points of a file."""

    def convert(columns, frames: slice | np.ndarray = slice(None)):
        return positions_file[frames][:, columns]

    return InspectedPoints(tuple(labels), np.arange(len(labels)), len(positions_file), rate, convert)


def estimate(labels, positions_file, default_axis="Z"):
    """Return the up axis of positions in file axes."""
    points = build_points(labels, positions_file)
    return estimate_up_axis(collect_body_evidence(points), sample_points(points), default_axis)


MOTIONS = {"stands": build_motion(), "walks": walk(), "lies prone": lie(PRONE), "lies supine": lie(SUPINE)}


@pytest.mark.parametrize("axis", "YZ")
@pytest.mark.parametrize("motion", MOTIONS)
def test_the_up_axis_of_a_person(motion, axis):
    assert estimate(LABELS, MOTIONS[motion] @ ROTATIONS_TO_Y_UP[axis], axis).letter == axis


@pytest.mark.parametrize("axis", AXIS_NAMES)
@pytest.mark.parametrize("motion", ["stands", "walks"])
def test_the_up_axis_of_an_upright_person_and_of_legs_alone_is_certain(motion, axis):
    positions = MOTIONS[motion] @ ROTATIONS_TO_Y_UP[axis]
    for markers in (range(len(LABELS)), LEGS):
        up_axis = estimate([LABELS[m] for m in markers], positions[:, list(markers)])
        assert up_axis.letter == axis
        assert up_axis.is_certain
        assert "standing feet" in up_axis.basis


def test_a_jump_shows_the_up_axis():
    height = np.zeros(120)
    flight = np.arange(24) / RATE
    height[60:84] = 2.0 * flight - 9.81 / 2 * flight**2
    positions = PERSON[:6] + height[:, None, None] * [0.0, 1.0, 0.0]
    for axis in AXIS_NAMES:
        found = find_free_fall(positions @ ROTATIONS_TO_Y_UP[axis], RATE)
        assert [name for name, is_fall in zip(AXIS_NAMES, found, strict=True) if is_fall] == [axis]
    assert not find_free_fall(positions[:50], RATE).any()
    up_axis = estimate([f"M{m}" for m in range(6)], positions)
    assert up_axis.letter == "Y"
    assert "free fall" in up_axis.basis


@pytest.mark.parametrize(
    ("label", "height"),
    [
        ("LFHD", 2), ("Jim:RBHD", 2), ("C7", 2), ("Top.Head", 2), ("R.Acromium", 2), ("LShoulderTop", 2), ("L_SAJ", 2),
        ("LASI", 1), ("R.PSIS", 1), ("V.Sacral", 1), ("WaistLFront", 1), ("ASISr", 1),
        ("LHEE", 0), ("R.Heel", 0), ("LToeIn", 0), ("RMT5", 0), ("L_FCC", 0), ("RAnkleOut", 0), ("LHeelBack", 0),
        ("WheelchairL", None), ("WheelchairL:Marker1", None), ("Wheelchair_Heelrest1", None),
        ("Tank", None), ("LKNE", None), ("Stick 1", None), ("", None),
    ],
)  # fmt: skip
def test_labels_are_matched_as_whole_words(label, height):
    assert classify_label_height(label) == height


def test_small_and_unknown_sets_have_the_usual_axis_and_are_uncertain():
    for positions in (build_motion(PERSON[:4] * 0.1), np.full((5, 3, 3), np.nan)):
        up_axis = estimate(["A", "B", "C", "D"][: positions.shape[1]], positions, "Y")
        assert (up_axis.letter, up_axis.is_certain) == ("Y", False)


def test_the_basis_is_reported_where_it_is_uncertain(tmp_path):
    path = tmp_path / "take.c3d"
    path.write_bytes(c3d_bytes(build_motion(PERSON[:4] * 0.1) * 1000, ["A", "B", "C", "D"]))
    take = capture.read_take(path)
    assert re.search("Z is assumed to be the up axis .*uncertain", describe_up_axis(take)[0])
    assert not describe_up_axis(capture.read_take(path, ReadOptions(up_axis="Y")))
    path.write_bytes(c3d_bytes(build_motion() * 1000, LABELS, extra={"POINT:Y_SCREEN": "+Y"}))
    take = capture.read_take(path)
    assert not describe_up_axis(take)
    assert take.up_axis is not None
    assert take.up_axis.basis == "POINT:Y_SCREEN of the file"


def test_subjects_in_labels():
    assert split_subjects_off(["Jim:LFHD", "A_RTOE"]) == (["Jim", ""], ["LFHD", "A_RTOE"])
    sides = ["L.ASIS", "R.ASIS", "L_ANKLE", "R_ANKLE", "R.Thigh.Upper", "R.Thigh.Rear"]
    assert split_subjects_off(sides) == ([""] * 6, sides)
    people = ["A_LFHD", "A_LTOE", "B-B.LASI", "B-B.RTOE"]
    assert split_subjects_off(people) == (["A", "A", "B-B", "B-B"], ["LFHD", "LTOE", "LASI", "RTOE"])
    assert split_subjects_off([]) == ([], [])

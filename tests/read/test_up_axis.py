import re
from pathlib import Path

import numpy as np
import pytest

from mocapfix.options import ReadOptions
from mocapfix.read import capture
from mocapfix.read.up_axis import classify_label_height, estimate_up_axis, find_free_fall
from mocapfix.report.notes import describe_up_axis
from tests.c3d_files import c3d_bytes

CAPTURES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures"
with_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
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
# Coordinates of Y-up positions in files whose up axis is X, Y or Z.
FILE_AXES = {"X": [1, 2, 0], "Y": [0, 1, 2], "Z": [2, 0, 1]}
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


MOTIONS = {"stands": build_motion(), "walks": walk(), "lies prone": lie(PRONE), "lies supine": lie(SUPINE)}


@pytest.mark.parametrize("axis", "YZ")
@pytest.mark.parametrize("motion", MOTIONS)
def test_the_up_axis_of_a_person(motion, axis):
    positions = MOTIONS[motion][..., FILE_AXES[axis]]
    assert estimate_up_axis(LABELS, positions, RATE, axis).letter == axis


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize("motion", ["stands", "walks"])
def test_the_up_axis_of_an_upright_person_and_of_legs_alone_is_certain(motion, axis):
    positions = MOTIONS[motion][..., FILE_AXES[axis]]
    for markers in (range(len(LABELS)), LEGS):
        up_axis = estimate_up_axis([LABELS[m] for m in markers], positions[:, list(markers)], RATE)
        assert up_axis.letter == axis
        assert up_axis.is_certain
        assert "head, pelvis and feet" in up_axis.basis


def test_a_jump_shows_the_up_axis():
    height = np.zeros(120)
    flight = np.arange(24) / RATE
    height[60:84] = 2.0 * flight - 9.81 / 2 * flight**2
    positions = PERSON[:6] + height[:, None, None] * [0.0, 1.0, 0.0]
    np.testing.assert_array_equal(find_free_fall(positions, RATE), [False, True, False])
    np.testing.assert_array_equal(find_free_fall(positions[..., FILE_AXES["Z"]], RATE), [False, False, True])
    assert not find_free_fall(positions[:50], RATE).any()
    up_axis = estimate_up_axis([f"M{m}" for m in range(6)], positions, RATE)
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
        up_axis = estimate_up_axis(["A", "B", "C", "D"][: positions.shape[1]], positions, RATE, "Y")
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


ROTATED = (
    "cmu/02_01.c3d",
    "cmu/85_02.c3d",
    "c3d/squat.c3d",
    "c3d/tennis_serve_motive.c3d",
    "c3d/S4-AMGait05.c3d",
    "trc/crlf.trc",
)


@with_captures
@pytest.mark.parametrize("name", ROTATED)
@pytest.mark.parametrize("axis", "XYZ")
def test_the_up_axis_of_rotated_captures(name, axis):
    take = capture.read_take(CAPTURES / name)
    up_axis = estimate_up_axis(take.labels, take.markers[..., FILE_AXES[axis]], take.rate)
    assert (up_axis.letter, up_axis.is_certain) == (axis, True)

"""The shipped marker sets: numbers of markers, symmetry, and positions on the body."""

import numpy as np
import pytest

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.library import load_marker_set, load_shipped_marker_sets
from tests.subject.sides import other_side

EACH = pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
WHOLE_BODY_SETS = (
    "cmu41", "frontwaist53", "helen-hayes", "opensim-gait", "optitrack-baseline41", "optitrack-core50", "plug-in-gait39",
    "production57", "qualisys-animation", "qualisys-sports",
)  # fmt: skip
EACH_WHOLE_BODY = pytest.mark.parametrize(
    "marker_set", [load_marker_set(name) for name in WHOLE_BODY_SETS], ids=lambda each: each.name
)
BONES = [f"{side}{bone}" for side in ("Left", "Right") for bone in ("Arm", "ForeArm", "UpLeg", "Leg", "Foot")]
FRONT = ("PX", "Front.Head", "L.ASIS", "L.Toe", "Chest", "LFHD", "CLAV", "STRN", "LTOE",
         "HeadFront", "ChestTop", "WaistLFront", "LToeTip", "Sternum", "L.Toe.Tip")  # fmt: skip
BACK = ("LBHD", "C7", "T10", "BackTop", "SpineTop", "BackLeft", "BackL", "WaistLBack", "WaistBack", "V.Sacral")
HEELS = ("LHEE", "LHEL", "LHeel", "LHeelBack", "L.Heel")


def test_the_shipped_sets():
    found = {each.name: (len(each.labels), len(each.optional_labels)) for each in load_shipped_marker_sets()}
    assert found == {
        "body25": (25, 6),
        "cast": (44, 18),
        "cgm2": (59, 13),
        "cmu41": (41, 0),
        "coco133": (33, 10),
        "coco17": (17, 0),
        "davis": (22, 2),
        "frontwaist53": (53, 0),
        "h36m17": (17, 0),
        "halpe26": (26, 6),
        "helen-hayes": (36, 14),
        "mediapipe33": (33, 16),
        "opencap": (48, 27),
        "opensim-gait": (52, 11),
        "opensim-rajagopal": (64, 22),
        "optitrack-baseline41": (41, 0),
        "optitrack-biomech57": (57, 0),
        "optitrack-core50": (50, 0),
        "plug-in-gait39": (49, 10),
        "production57": (57, 4),
        "qualisys-animation": (44, 4),
        "qualisys-paf": (88, 59),
        "qualisys-sports": (41, 6),
        "rizzoli": (53, 22),
        "visual3d-coda": (44, 18),
    }


@EACH
def test_left_and_right_are_symmetric(marker_set):
    names, sided = load_cmu31_body().skeleton.names, 0
    for k, label in enumerate(marker_set.labels):
        if (twin := other_side(label)) in marker_set.labels and twin != label:
            other = marker_set.labels.index(twin)
            np.testing.assert_array_equal(marker_set.marker_offsets[other], marker_set.marker_offsets[k] * [-1, 1, 1])
            joint = names[marker_set.joints[k]]
            assert names[marker_set.joints[other]] in (joint.replace("Left", "Right"), joint.replace("Right", "Left"))
            assert (twin in marker_set.optional_labels) == (
                label in marker_set.optional_labels
            ) or "BAK" in label  # the right one is the rule
            sided += 1
    assert sided >= 0.7 * len(marker_set.labels)


@EACH
def test_left_markers_are_on_the_left(marker_set):
    for label, joint, place in zip(marker_set.labels, marker_set.joints, marker_set.marker_offsets, strict=True):
        has_side = other_side(label) in marker_set.labels or "BAK" in label
        if has_side and other_side(label) != label and load_cmu31_body().skeleton.names[joint] in ("Hips", "Spine1", "Head"):
            left = other_side(label).casefold() > label.casefold()  # "L" comes before "R"
            assert (place[0] > 0) == left, label


@EACH_WHOLE_BODY
def test_markers_lie_on_the_body(marker_set):
    """Front markers in front, back ones behind, and none farther from its joint than the knee marker from the hip."""
    place = dict(zip(marker_set.labels, marker_set.marker_offsets, strict=True))
    assert (np.linalg.norm(marker_set.marker_offsets, axis=1) < 0.45).all()
    assert ((marker_set.marker_spread > 0.005) & (marker_set.marker_spread <= 0.06)).all()
    assert sum(label in place for label in FRONT) >= 3
    assert all(place[label][2] > 0 for label in FRONT if label in place)
    assert all(place[label][2] < 0 for label in (*BACK, *HEELS) if label in place)
    assert any(heel in place for heel in HEELS)


@EACH_WHOLE_BODY
def test_every_segment_group_has_markers(marker_set):
    there = {load_cmu31_body().skeleton.names[joint] for joint in marker_set.joints}
    assert {"Hips", "Spine1", "Head", *BONES} <= there

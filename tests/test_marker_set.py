from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import SceneError
from mocapfix.marker_set import choose, load, shipped
from mocapfix.skeleton import cmu31

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data" / "captures"
CMU, GAIT = load("cmu41"), load("plug-in-gait39")
EACH = pytest.mark.parametrize("marker_set", shipped(), ids=lambda each: each.name)


def test_the_shipped_sets():
    found = [(each.name, len(each.labels)) for each in shipped()]
    assert found == [("cmu41", 41), ("frontwaist53", 53), ("plug-in-gait39", 39)]


@EACH
def test_left_and_right_are_alike(marker_set):
    names = cmu31().skeleton.names
    for label, joint, place in zip(marker_set.labels, marker_set.joints, marker_set.places, strict=True):
        if label.startswith("L"):
            other = marker_set.labels.index("R" + label[1:])
            np.testing.assert_array_equal(marker_set.places[other], place * [-1, 1, 1])
            assert names[marker_set.joints[other]] == names[joint].replace("Left", "Right")


@EACH
def test_markers_lie_on_the_body(marker_set):
    """Front markers in front, back ones behind, and none farther from its joint than the knee marker from the hip."""
    place = dict(zip(marker_set.labels, marker_set.places, strict=True))
    assert (np.linalg.norm(marker_set.places, axis=1) < 0.45).all()
    assert ((marker_set.spread > 0.005) & (marker_set.spread < 0.05)).all()
    assert all(place[label][2] > 0 for label in ("LFHD", "CLAV", "STRN", "LTOE"))
    assert all(place[label][2] < 0 for label in ("LBHD", "C7", "T10", "LHEE" if "LHEE" in place else "LHEL"))


@EACH
@given(data=st.data())
def test_labels_are_found_in_any_order_case_and_alias(marker_set, data):
    order = data.draw(st.permutations(range(len(marker_set.labels))))
    names = [data.draw(st.sampled_from((marker_set.labels[k], *marker_set.aliases[k]))) for k in order]
    labels = [f"Jim:{data.draw(st.sampled_from((name, name.lower())))} " for name in names]
    assert marker_set.match(labels) == {marker_set.labels[k]: index for index, k in enumerate(order)}


def test_the_first_of_equal_labels_and_the_own_name_count():
    assert CMU.match(("LTIB", "LSHN", "LFHD", "lfhd")) == {"LSHN": 1, "LFHD": 2}


def test_the_subject_with_the_most_markers_is_taken():
    labels = ("Prop:LFHD", "Prop:Handle", "Ann:C7", "Ann:LFHD", "LFWT")
    assert CMU.match(labels) == {"C7": 2, "LFHD": 3}
    assert CMU.match(()) == {}


@EACH
def test_a_set_fits_its_own_labels(marker_set):
    choice = choose(marker_set.labels)
    assert choice.marker_set is marker_set
    assert f"{len(marker_set.labels)} of its {len(marker_set.labels)}" in choice.reason


def test_one_lost_arm_still_fits_and_two_do_not():
    names = cmu31().skeleton.names
    arm = ("Arm", "ForeArm", "Hand")
    joint = {label: names[j] for label, j in zip(GAIT.labels, GAIT.joints, strict=True)}
    one = [x for x in GAIT.labels if joint[x] not in [f"Left{bone}" for bone in arm]]
    none = [x for x in one if joint[x] not in [f"Right{bone}" for bone in arm]]
    assert choose(one).marker_set is GAIT
    assert choose(none).marker_set is None
    assert "the left arm, right arm can hardly be seen; not found: LUPA, LELB, LFRM" in choose(none).reason


@pytest.mark.parametrize("joint", ["Hips", "Spine1"])
def test_a_body_without_hips_or_thorax_does_not_fit(joint):
    wanted = cmu31().skeleton.index(joint)
    assert choose([label for label, j in zip(CMU.labels, CMU.joints, strict=True) if j != wanted]).marker_set is None


def test_60_percent_are_enough_and_one_less_is_not():
    first = ["LFWT", "CLAV", "LUPA", "LELB", "LTHI", "LKNE", "RTHI", "RKNE"]  # hips, thorax and three limbs
    labels = first + [label for label in CMU.labels if label not in first]
    assert choose(labels[:25]).marker_set is CMU  # 0.6 * 41 = 24.6
    assert "at least 60%" in choose(labels[:24]).reason


def test_legs_only_say_what_was_found_and_what_was_lacking():
    labels = ("LASI", "RASI", "LTHI", "LKNE", "LTIB", "LANK", "LHEE", "LTOE", "RTHI", "RKNE", "RTIB", "RANK", "RHEE", "RTOE")
    choice = choose(labels)
    assert choice.marker_set is None
    assert choice.reason == (
        "No marker set fits the labels LASI, RASI, LTHI, LKNE, LTIB, LANK, LHEE, LTOE, RTHI, RKNE, RTIB, RANK and 2 more: "
        "nearest came plug-in-gait39 with 14 of its 39 markers, but the thorax, left arm, right arm can hardly be "
        "seen; not found: LFHD, RFHD, LBHD, RBHD, C7, T10, CLAV, STRN, RBAK, LSHO, LUPA, LELB and 13 more."
    )


@pytest.mark.parametrize("labels", [(), ("Racket:tip", "Racket:grip")])
def test_labels_of_no_set(labels):
    assert choose(labels).marker_set is None
    assert "cmu41, frontwaist53, plug-in-gait39" in choose(labels).reason


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(SceneError, match=r"baseline41.*cmu41, frontwaist53, plug-in-gait39.*YAML"):
        load("baseline41")


GOOD = """
name: mine
title: Mine
skeleton: cmu31
markers:
  TOP: {joint: Head, offset: [0, 0.2, 0], spread: 0.01, aliases: [CROWN]}
  HIP: {joint: Hips, offset: [0.1, 0, 0.1], spread: 0.02}
"""


def test_a_file_of_ones_own(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD)
    mine = load(path)
    assert (mine.name, mine.labels, mine.aliases) == ("mine", ("TOP", "HIP"), (("CROWN",), ()))
    assert [cmu31().skeleton.names[j] for j in mine.joints] == ["Head", "Hips"]
    np.testing.assert_array_equal(mine.places, [[0, 0.2, 0], [0.1, 0, 0.1]])
    np.testing.assert_array_equal(mine.spread, [0.01, 0.02])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("joint: Head", "joint: Skull", r"markers\.TOP\.joint: there is no joint 'Skull'; the joints are Hips, "),
        ("[0, 0.2, 0]", "[0, 0.2]", r"markers\.TOP\.offset\.2: "),
        ("[0, 0.2, 0]", "[0, .nan, 0]", r"markers\.TOP\.offset\.1: "),
        ("spread: 0.02", "spread: 0", r"markers\.HIP\.spread: .*greater than 0"),
        ("skeleton: cmu31", "skeleton: smpl", "skeleton: .*'cmu31'"),
        ("title: Mine", "tilte: Mine", "title: "),
        ("title: Mine", "title: Mine\ncolour: red", "colour: "),
        ("[CROWN]", "[hip]", "markers: HIP would name more than one marker"),
        ("name: mine", "name: [", "line "),
        (GOOD, "just text", "no key: value pairs"),
    ],
)
def test_a_wrong_file_names_the_key(tmp_path, old, new, said):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(SceneError, match=rf"mine\.yaml.*{said}"):
        load(path)


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
@pytest.mark.parametrize(
    ("take", "name", "found"),
    [
        ("cmu/01_01.c3d", "cmu41", 41),
        ("cmu/05_13.c3d", "cmu41", 41),
        ("c3d/HDM_bd_05-01_01_120.c3d", "cmu41", 41),
        ("c3d/squat.c3d", "frontwaist53", 53),
        ("c3d/tennis_serve_motive.c3d", "plug-in-gait39", 39),
        ("c3d/FunctionalWalk.c3d", "plug-in-gait39", 39),
        ("c3d/hockey_whole_body.c3d", "plug-in-gait39", 39),
        ("c3d/walking2.c3d", None, 0),
        ("c3d/Qualisys.c3d", None, 0),
        ("c3d/sub_labels.c3d", None, 0),
    ],
)
def test_captures_get_their_set(take, name, found):
    ezc3d = pytest.importorskip("ezc3d")
    labels = ezc3d.c3d(str(CAPTURES / take))["parameters"]["POINT"]["LABELS"]["value"]
    chosen = choose(labels).marker_set
    assert (chosen and chosen.name) == name
    assert chosen is None or len(chosen.match(labels)) == found

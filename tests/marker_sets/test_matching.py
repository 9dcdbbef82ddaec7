"""Which set a take wears."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.marker_sets import choose_marker_set, load_marker_set, load_shipped_marker_sets
from mocapfix.skeleton import load_cmu31_body

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data" / "captures"
CMU, GAIT = load_marker_set("cmu41"), load_marker_set("plug-in-gait39")
EACH = pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
STRANGERS = ("Stick 1", "Stick 2", "Puck", "Sword_tip", "Floor.1")
SPELLINGS = {
    "its own": lambda labels: labels,
    "those that it must have": lambda labels: labels,
    "lower case": lambda labels: [label.lower() for label in labels],
    "an actor's": lambda labels: [f"Jim:{label}" for label in labels],
    "Qualisys actor's": lambda labels: [f"Q_{label}" for label in labels],
    "Motive skeleton's": lambda labels: [f"Skeleton_Name_{label}" for label in labels],
    "with strangers": lambda labels: [*STRANGERS, *labels],
    "an actor's with strangers": lambda labels: [*STRANGERS, *(f"Jim:{label}" for label in labels)],
    "reversed": lambda labels: labels[::-1],
}


@EACH
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_sets_labels_choose_it(marker_set, spelling):
    labels = list(marker_set.required_labels if spelling == "those that it must have" else marker_set.labels)
    choice = choose_marker_set(SPELLINGS[spelling](labels))
    assert choice.marker_set is marker_set
    assert f": {len(marker_set.required_labels)} of its {len(marker_set.required_labels)} markers" in choice.reason


@EACH
@pytest.mark.parametrize("seed", range(10))
def test_a_set_of_which_some_are_absent_is_still_chosen(marker_set, seed):
    rng, count = np.random.default_rng(seed), len(marker_set.required_labels)
    while True:  # another lot, where the only marker of the thorax is among the absent
        left = rng.permutation(count)[max(2, count // 10) :]
        labels = [marker_set.required_labels[k] for k in sorted(left)]
        if not marker_set.describe_missing_body(labels):
            break
    assert choose_marker_set(labels).marker_set is marker_set
    assert choose_marker_set([*STRANGERS, *(f"Jim:{label.lower()}" for label in labels)]).marker_set is marker_set


def test_what_a_set_may_do_without_is_told_apart():
    assert choose_marker_set([*GAIT.required_labels, "LKNEin", "RKNEin"]).reason == (
        "Plug-in Gait full body 39: 39 of its 39 markers and 2 that it may do without were found."
    )


def test_one_lost_arm_still_fits_and_two_do_not():
    names = load_cmu31_body().skeleton.names
    arm = ("Arm", "ForeArm", "Hand")
    joint = {label: names[j] for label, j in zip(GAIT.labels, GAIT.joints, strict=True)}
    one = [x for x in GAIT.labels if joint[x] not in [f"Left{bone}" for bone in arm]]
    none = [x for x in one if joint[x] not in [f"Right{bone}" for bone in arm]]
    assert choose_marker_set(one).marker_set is GAIT
    assert choose_marker_set(none).marker_set is None
    assert "the left arm, right arm can hardly be seen; not found: LUPA, LELB, LFRM" in choose_marker_set(none).reason


@pytest.mark.parametrize("joint", ["Hips", "Spine1"])
def test_a_body_without_hips_or_thorax_does_not_fit(joint):
    wanted = load_cmu31_body().skeleton.find_joint(joint)
    assert choose_marker_set([label for label, j in zip(CMU.labels, CMU.joints, strict=True) if j != wanted]).marker_set is None


def test_60_percent_are_enough_and_one_less_is_not():
    first = ["LFWT", "CLAV", "LUPA", "LELB", "LTHI", "LKNE", "RTHI", "RKNE"]  # hips, thorax and three limbs
    labels = first + [label for label in CMU.labels if label not in first]
    assert choose_marker_set(labels[:25]).marker_set is CMU  # 0.6 * 41 = 24.6
    assert "at least 60%" in choose_marker_set(labels[:24]).reason


def test_legs_only_say_what_was_found_and_what_was_lacking():
    labels = ("LASI", "RASI", "LTHI", "LKNE", "LTIB", "LANK", "LHEE", "LTOE", "RTHI", "RKNE", "RTIB", "RANK", "RHEE", "RTOE")
    choice = choose_marker_set(labels)
    assert choice.marker_set is None
    assert choice.reason == (
        "No marker set fits the labels LASI, RASI, LTHI, LKNE, LTIB, LANK, LHEE, LTOE, RTHI, RKNE, RTIB, RANK and 2 more: "
        "nearest came plug-in-gait39 with 14 of its 39 markers, but the thorax, left arm, right arm can hardly be "
        "seen; not found: LFHD, RFHD, LBHD, RBHD, C7, T10, CLAV, STRN, RBAK, LSHO, LUPA, LELB and 13 more."
    )


@pytest.mark.parametrize("labels", [(), ("Racket:tip", "Racket:grip")])
def test_labels_of_no_set(labels):
    assert choose_marker_set(labels).marker_set is None
    assert "cmu41, frontwaist53, helen-hayes, opensim-gait, optitrack-baseline41" in choose_marker_set(labels).reason


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
@pytest.mark.parametrize(
    ("take", "name", "found"),
    [
        ("cmu/01_01.c3d", "cmu41", 41),
        ("cmu/05_13.c3d", "cmu41", 41),
        ("c3d/HDM_bd_05-01_01_120.c3d", "cmu41", 41),
        ("c3d/squat.c3d", "production57", 53),
        ("c3d/tennis_serve_motive.c3d", "plug-in-gait39", 39),
        ("c3d/FunctionalWalk.c3d", "plug-in-gait39", 45),
        ("c3d/hockey_whole_body.c3d", "plug-in-gait39", 39),
        ("c3d/walking2.c3d", None, 0),
        ("c3d/Qualisys.c3d", None, 0),
        ("c3d/sub_labels.c3d", None, 0),
    ],
)
def test_captures_get_their_set(take, name, found):
    ezc3d = pytest.importorskip("ezc3d")
    labels = ezc3d.c3d(str(CAPTURES / take))["parameters"]["POINT"]["LABELS"]["value"]
    chosen = choose_marker_set(labels).marker_set
    assert (chosen and chosen.name) == name
    assert chosen is None or len(chosen.match_labels(labels)) == found

"""Which shipped marker set fits the labels of a take."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.marker_sets import choose_marker_set, load_marker_set, load_shipped_marker_sets
from mocapfix.skeleton import load_cmu31_body

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data" / "captures"
CMU, GAIT = load_marker_set("cmu41"), load_marker_set("plug-in-gait39")
EACH = pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
OTHER_LABELS = ("Stick 1", "Stick 2", "Puck", "Sword_tip", "Floor.1")
SPELLINGS = {
    "as named": lambda labels: labels,
    "required labels": lambda labels: labels,
    "lower case": lambda labels: [label.lower() for label in labels],
    "with a prefix": lambda labels: [f"Jim:{label}" for label in labels],
    "Qualisys prefix": lambda labels: [f"Q_{label}" for label in labels],
    "Motive prefix": lambda labels: [f"Skeleton_Name_{label}" for label in labels],
    "with other labels": lambda labels: [*OTHER_LABELS, *labels],
    "with a prefix with other labels": lambda labels: [*OTHER_LABELS, *(f"Jim:{label}" for label in labels)],
    "reversed": lambda labels: labels[::-1],
}


@EACH
@pytest.mark.parametrize("spelling", SPELLINGS)
def test_labels_of_a_set_choose_it(marker_set, spelling):
    labels = list(marker_set.required_labels if spelling == "required labels" else marker_set.labels)
    choice = choose_marker_set(SPELLINGS[spelling](labels))
    assert choice.marker_set is marker_set
    assert f": {len(marker_set.required_labels)} of its {len(marker_set.required_labels)} markers" in choice.reason


@EACH
@pytest.mark.parametrize("seed", range(10))
def test_set_with_missing_markers_is_chosen(marker_set, seed):
    rng, count = np.random.default_rng(seed), len(marker_set.required_labels)
    while True:  # draw again if the only marker of the thorax is missing
        kept = rng.permutation(count)[max(2, count // 10) :]
        labels = [marker_set.required_labels[k] for k in sorted(kept)]
        if not marker_set.describe_missing_body(labels):
            break
    assert choose_marker_set(labels).marker_set is marker_set
    assert choose_marker_set([*OTHER_LABELS, *(f"Jim:{label.lower()}" for label in labels)]).marker_set is marker_set


def test_reason_counts_optional_markers_separately():
    assert choose_marker_set([*GAIT.required_labels, "LKNEin", "RKNEin"]).reason == (
        "Plug-in Gait full body 39: 39 of its 39 markers and 2 optional ones were found."
    )


def test_body_may_lack_one_arm_but_not_two():
    names = load_cmu31_body().skeleton.names
    arm = ("Arm", "ForeArm", "Hand")
    joint = {label: names[j] for label, j in zip(GAIT.labels, GAIT.joints, strict=True)}
    one = [x for x in GAIT.labels if joint[x] not in [f"Left{bone}" for bone in arm]]
    none = [x for x in one if joint[x] not in [f"Right{bone}" for bone in arm]]
    assert choose_marker_set(one).marker_set is GAIT
    assert choose_marker_set(none).marker_set is None
    assert "the left arm, right arm cannot be located; not found: LUPA, LELB, LFRM" in choose_marker_set(none).reason


@pytest.mark.parametrize("joint", ["Hips", "Spine1"])
def test_body_without_hips_or_thorax_does_not_fit(joint):
    wanted = load_cmu31_body().skeleton.find_joint(joint)
    assert choose_marker_set([label for label, j in zip(CMU.labels, CMU.joints, strict=True) if j != wanted]).marker_set is None


def test_sixty_percent_of_the_markers_are_needed():
    first = ["LFWT", "CLAV", "LUPA", "LELB", "LTHI", "LKNE", "RTHI", "RKNE"]  # hips, thorax and three limbs
    labels = first + [label for label in CMU.labels if label not in first]
    assert choose_marker_set(labels[:25]).marker_set is CMU  # 0.6 * 41 = 24.6
    assert "at least 60%" in choose_marker_set(labels[:24]).reason


def test_reason_lists_found_and_missing_markers():
    labels = ("LASI", "RASI", "LTHI", "LKNE", "LTIB", "LANK", "LHEE", "LTOE", "RTHI", "RKNE", "RTIB", "RANK", "RHEE", "RTOE")
    choice = choose_marker_set(labels)
    assert choice.marker_set is None
    assert choice.reason == (
        "No marker set fits the labels LASI, RASI, LTHI, LKNE, LTIB, LANK, LHEE, LTOE, RTHI, RKNE, RTIB, RANK and 2 more: "
        "the nearest is plug-in-gait39 with 14 of its 39 markers, but the thorax, left arm, right arm cannot be "
        "located; not found: LFHD, RFHD, LBHD, RBHD, C7, T10, CLAV, STRN, RBAK, LSHO, LUPA, LELB and 13 more."
    )


@pytest.mark.parametrize("labels", [(), ("Racket:tip", "Racket:grip")])
def test_unknown_labels_list_the_shipped_sets(labels):
    assert choose_marker_set(labels).marker_set is None
    assert "cmu41, frontwaist53, helen-hayes, opensim-gait, optitrack-baseline41" in choose_marker_set(labels).reason


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
@pytest.mark.parametrize(
    ("take", "name", "marker_count"),
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
def test_sets_of_real_captures(take, name, marker_count):
    ezc3d = pytest.importorskip("ezc3d")
    labels = ezc3d.c3d(str(CAPTURES / take))["parameters"]["POINT"]["LABELS"]["value"]
    chosen = choose_marker_set(labels).marker_set
    assert (chosen and chosen.name) == name
    assert chosen is None or len(chosen.match_labels(labels)) == marker_count

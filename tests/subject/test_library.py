"""Marker set files: reading, errors in them, and writing. Which shipped marker set fits the labels of a take."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import SceneError, WriteError
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.library import choose_marker_set, load_marker_set, load_shipped_marker_sets, write_marker_set
from tests.captures import CAPTURES, needs_captures


def test_unknown_name_lists_the_shipped_sets():
    with pytest.raises(SceneError, match=r"baseline41.*body25, cast, .*, cmu41.* and \d+ more, .*YAML"):
        load_marker_set("baseline41")


def test_set_is_found_by_its_other_name():
    assert load_marker_set("hdm05") is load_marker_set("cmu41")
    names = [name for each in load_shipped_marker_sets() for name in (each.name, *each.other_names)]
    assert len(set(names)) == len(names)


GOOD = """
name: mine
title: Mine
skeleton: cmu31
markers:
  TOP: {joint: Head, offset: [0, 0.2, 0], spread: 0.01, aliases: [CROWN], optional: true}
  HIP: {joint: Hips, offset: [0.1, 0, 0.1], spread: 0.02}
"""


def test_file_of_a_studio(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD, encoding="utf-8")
    marker_set = load_marker_set(path)
    assert (marker_set.name, marker_set.labels, marker_set.aliases) == ("mine", ("TOP", "HIP"), (("CROWN",), ()))
    assert (marker_set.optional_labels, marker_set.required_labels) == ({"TOP"}, ("HIP",))
    assert [load_cmu31_body().skeleton.names[j] for j in marker_set.joints] == ["Head", "Hips"]
    np.testing.assert_array_equal(marker_set.marker_offsets, [[0, 0.2, 0], [0.1, 0, 0.1]])
    np.testing.assert_array_equal(marker_set.marker_spread, [0.01, 0.02])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("joint: Head", "joint: Skull", r"markers\.TOP\.joint: there is no joint 'Skull'; the joints are Hips, "),
        ("[0, 0.2, 0]", "[0, 0.2]", r"markers\.TOP\.offset\.2: "),
        ("[0, 0.2, 0]", "[0, .nan, 0]", r"markers\.TOP\.offset\.1: "),
        ("spread: 0.02", "spread: 0", r"markers\.HIP\.spread: .*greater than 0"),
        ("skeleton: cmu31", "skeleton: smpl", "skeleton: .*'cmu31'"),
        ("title: Mine", "tilte: Mine", "title: "),
        ("title: Mine", "title: Mine\ncolour: red", "colour: "),
        ("[CROWN]", "[hip]", "markers: HIP names more than one marker"),
        ("[CROWN]", "[T.O.P]", "markers: TOP names more than one marker"),
        ("TOP:", "'._':", r"markers: \._ has neither letters nor digits"),
        ("optional: true", "optional: perhaps", r"markers\.TOP\.optional: "),
        ("name: mine", "name: [", "line "),
        (GOOD, "just text", "no key: value pairs"),
    ],
)
def test_error_names_the_wrong_key(tmp_path, old, new, message):
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD.replace(old, new), encoding="utf-8")
    with pytest.raises(SceneError, match=rf"mine\.yaml.*{message}"):
        load_marker_set(path)


@pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
def test_written_set_is_read_back(marker_set, tmp_path):
    write_marker_set(tmp_path / "mine.yaml", marker_set, "Two lines\n\nof comment.")
    assert (tmp_path / "mine.yaml").read_text(encoding="utf-8").startswith("# Two lines\n#\n# of comment.\nname: ")
    back = load_marker_set(tmp_path / "mine.yaml")
    assert all(
        getattr(back, name) == getattr(marker_set, name) for name in ("name", "title", "labels", "aliases", "optional_labels")
    )
    for name in ("joints", "marker_offsets", "marker_spread"):
        np.testing.assert_array_equal(getattr(back, name), getattr(marker_set, name))


LABELS = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1)


@given(labels=st.lists(LABELS, min_size=1, max_size=5))
def test_any_labels_can_be_written(tmp_path_factory, labels):
    names = {f"{label}{k}x": label for k, label in enumerate(labels)}
    count, path = len(names), tmp_path_factory.mktemp("set") / "mine.yaml"
    marker_set = replace(
        load_marker_set("cmu41"), labels=tuple(names), joints=np.zeros(count, int), marker_offsets=np.ones((count, 3)),
        marker_spread=np.ones(count), aliases=((),) * count,
    )  # fmt: skip
    try:
        write_marker_set(path, marker_set)
        assert load_marker_set(path).labels == marker_set.labels
    except SceneError as error:
        assert "names more than one marker" in str(error)  # noqa: PT017


def test_missing_folder_is_an_error(tmp_path):
    with pytest.raises(WriteError, match=r"mine\.yaml: cannot be written"):
        write_marker_set(tmp_path / "nowhere" / "mine.yaml", load_marker_set("cmu41"))


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


LEGS_OF_PLUG_IN_GAIT = ("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")


@pytest.mark.parametrize(
    ("endings", "name"),
    [
        (LEGS_OF_PLUG_IN_GAIT, "plug-in-gait39"),
        ((*LEGS_OF_PLUG_IN_GAIT, "KNM", "MED"), "plug-in-gait39"),
        ((*LEGS_OF_PLUG_IN_GAIT, "THAP", "THAD", "TIAP", "TIAD"), "cgm2"),
        ((*LEGS_OF_PLUG_IN_GAIT, "THAP", "THAD", "TIAP", "TIAD", "KNM", "MED", "SMH", "FMH", "VMH"), "cgm2"),
        (("ASIS", "PSIS", "GT", "LE", "ME", "HF", "TT", "LM", "MM", "CA", "FM", "SM", "VM"), "rizzoli"),
        (("_IAS", "_IPS", "_FLE", "_FME", "_TTC", "_FAL", "_TAM", "_FCC", "_FM1", "_FM5", "_TH1", "_TH2", "_TH3", "_SK1", "_SK2",
          "_SK3"), "qualisys-paf"),
        (("IAS", "IPS", "FTC", "TH", "FLE", "FME", "FAX", "TTC", "SK", "FAL", "TAM", "FCC", "FM1", "FM2", "FM5", "DP1"),
         "optitrack-biomech57"),
        (("ASIS", "PSIS", "TH1", "TH2", "TH3", "TH4", "SH1", "SH2", "SH3", "SH4", "LE", "LM", "CA", "FM", "VM"), "cast"),
        (("ASIS", "PSIS", "TH1", "TH2", "TH3", "TH4", "SK1", "SK2", "SK3", "SK4", "LK", "MK", "LA", "MA", "HEEL", "1MT", "5MT"),
         "visual3d-coda"),
        (("ASI", "PSI", "TH1", "TH2", "TH3", "LFC", "MFC", "TB1", "TB2", "TB3", "LMAL", "MMAL", "CAL", "TOE", "MT5"),
         "opensim-rajagopal"),
    ],
)  # fmt: skip
def test_sets_of_laboratories_with_equal_labels_are_distinguished(endings, name):
    chosen = choose_marker_set([side + ending for ending in endings for side in "LR"]).marker_set
    assert (chosen and chosen.name) == name


@pytest.mark.parametrize(
    ("median", "name"),
    [
        (("Hip", "Neck", "Head", "Nose"), "halpe26"),
        (("CHip", "Neck", "Nose"), "body25"),
    ],
)
def test_keypoints_of_pose2sim_choose_their_set(median, name):
    endings = ("Hip", "Knee", "Ankle", "BigToe", "SmallToe", "Heel", "Shoulder", "Elbow", "Wrist")
    chosen = choose_marker_set([*median, *(side + ending for ending in endings for side in "RL")]).marker_set
    assert (chosen and chosen.name) == name


def test_reason_counts_optional_markers_separately():
    assert choose_marker_set([*GAIT.required_labels, "LKNEin", "RKNEin"]).reason == (
        "Plug-in Gait full body 39: 39 of its 39 markers and 2 optional ones were found."
    )


REDUCED = ("LFHD", "C7", "LELB", "LWRA", "RELB", "RWRA", "LFWT", "RFWT", "RBWT", "LKNE", "LANK", "LTOE", "RKNE", "RANK", "RTOE")


def test_a_few_markers_of_a_set_are_used_if_all_labels_are_its_own():
    chosen = choose_marker_set(REDUCED).marker_set
    assert chosen is not None
    assert chosen.name == CMU.name
    assert set(chosen.labels) == set(REDUCED)
    assert CMU.describe_incomplete_body(REDUCED)


def test_a_few_markers_of_a_set_are_not_used_beside_many_others():
    assert choose_marker_set([*REDUCED, "ONE", "TWO", "THREE"]).marker_set is None


def test_a_few_markers_that_do_not_locate_a_body_are_not_a_reduced_set():
    assert choose_marker_set(["LFHD", "LELB", "LWRA", "RELB", "RWRA", "LFWT"]).marker_set is None


def test_whole_body_may_lack_one_arm_but_not_two():
    names = load_cmu31_body().skeleton.names
    arm = ("Arm", "ForeArm", "Hand")
    joint = {label: names[j] for label, j in zip(GAIT.labels, GAIT.joints, strict=True)}
    one = [x for x in GAIT.labels if joint[x] not in [f"Left{bone}" for bone in arm]]
    none = [x for x in one if joint[x] not in [f"Right{bone}" for bone in arm]]
    assert not GAIT.describe_incomplete_body(one)
    assert "the left arm, right arm cannot be located; not found: LUPA, LELB, LFRM" in GAIT.describe_incomplete_body(none)
    assert GAIT.find_shown_sections(none) == ("pelvis", "trunk", "head", "left leg", "right leg")
    assert choose_marker_set(one).marker_set is choose_marker_set(none).marker_set is GAIT


@pytest.mark.parametrize(
    ("joint", "sections"),
    [("Hips", ("trunk", "head", "left arm", "right arm")), ("Spine1", ("pelvis", "left leg", "right leg"))],
)
def test_without_hips_or_thorax_the_body_on_one_side_of_them_is_a_part(joint, sections):
    removed = load_cmu31_body().skeleton.find_joint(joint)
    labels = [label for label, j in zip(CMU.labels, CMU.joints, strict=True) if j != removed]
    assert CMU.describe_incomplete_body(labels)
    assert CMU.find_shown_sections(labels) == sections
    assert choose_marker_set(labels).marker_set is CMU


def test_sixty_percent_of_the_markers_of_a_whole_body_are_needed():
    first = ["LFWT", "CLAV", "LUPA", "LELB", "LTHI", "LKNE", "RTHI", "RKNE"]  # hips, thorax and three limbs
    labels = first + [label for label in CMU.labels if label not in first]
    assert not CMU.describe_incomplete_body(labels[:25])  # 0.6 * 41 = 24.6
    assert "at least 60%" in CMU.describe_incomplete_body(labels[:24])


PELVIS, LEG, TRUNK, ARM = (
    ("LFWT", "RFWT", "LBWT", "RBWT"),
    ("LTHI", "LKNE", "LSHN", "LANK", "LHEE", "LTOE", "LMT5"),
    ("C7", "T10", "CLAV", "STRN", "RBAC"),
    ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN"),
)
HEAD = ("LFHD", "RFHD", "LBHD", "RBHD")


@pytest.mark.parametrize(
    ("labels", "sections"),
    [
        ((*PELVIS, *LEG), ("pelvis", "left leg")),
        (LEG, ("left leg",)),
        ((*TRUNK, *ARM), ("trunk", "left arm")),
        ((*TRUNK, *ARM, *HEAD), ("trunk", "head", "left arm")),
        ((*PELVIS, *LEG, *TRUNK), ("pelvis", "trunk", "left leg")),
        ((*PELVIS, *LEG, *ARM), ("pelvis", "left leg")),  # nothing connects the arm
        ((*PELVIS, *LEG, "C7", "CLAV"), ("pelvis", "left leg")),
    ],
)
def test_part_of_a_body_is_connected(labels, sections):
    assert CMU.find_shown_sections(labels) == sections
    part = CMU.select_shown_part(labels)
    assert set(part.labels) <= set(labels)
    assert part.find_shown_sections(part.labels) == sections
    mirrored = [f"R{label[1:]}" if label in (*LEG, *ARM) else label for label in labels]
    assert CMU.find_shown_sections(mirrored) == tuple(section.replace("left", "right") for section in sections)


@pytest.mark.parametrize(
    "labels",
    [
        PELVIS,
        (*PELVIS, "LTHI", "LSHN"),  # wands
        (*PELVIS, *TRUNK, *HEAD),  # no limb
        HEAD,
        TRUNK,
        LEG[1:],  # one marker on the thigh
        (*PELVIS[:2], *LEG[:4]),
    ],
)
def test_few_markers_are_no_part_of_a_body(labels):
    assert CMU.find_shown_sections(labels) == ()
    assert choose_marker_set(labels).marker_set is None
    assert CMU.select_shown_part(labels).labels == ()


def test_whole_body_keeps_the_markers_that_were_not_found():
    labels = [label for label in CMU.labels if label not in ("LFHD", "RELB", "LTHI")]
    assert CMU.select_shown_part(labels) is CMU
    assert set(CMU.labels) - set(CMU.select_shown_part([x for x in labels if x != "LFIN"]).labels) == {"LFIN"}


def test_reason_lists_found_and_missing_markers():
    labels = ("LASI", "RASI", "LTHI", "LANK", "LHEE", "LTOE", "RTHI", "RANK", "RHEE", "RTOE", "LMT1", "RMT1")
    choice = choose_marker_set(labels)
    assert choice.marker_set is None
    assert choice.reason == (
        "No marker set fits the labels LASI, RASI and 10 more: "
        "the nearest is plug-in-gait39 with 10 of its 39 markers and 2 optional ones, but the thorax, left arm, right arm cannot "
        "be located."
    )


@pytest.mark.parametrize("labels", [(), ("Racket:tip", "Racket:grip")])
def test_unknown_labels_are_in_no_shipped_set(labels):
    assert choose_marker_set(labels).marker_set is None
    assert "none of them is in a shipped set; `mocapfix marker-set list` shows these" in choose_marker_set(labels).reason


@needs_captures
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
        ("c3d/walking2.c3d", "opensim-rajagopal", 38),
        ("c3d/Qualisys.c3d", "qualisys-paf", 55),
        ("c3d/S4-AMGait05.c3d", "plug-in-gait39", 16),
        ("c3d/JA1Gait35.c3d", None, 0),
        ("c3d/dec_real.c3d", "visual3d-coda", 26),
        ("c3d/ADemo1_pc_integer.c3d", None, 0),
    ],
)
def test_sets_of_real_captures(take, name, marker_count):
    ezc3d = pytest.importorskip("ezc3d")
    labels = ezc3d.c3d(str(CAPTURES / take))["parameters"]["POINT"]["LABELS"]["value"]
    chosen = choose_marker_set(labels).marker_set
    assert (chosen and chosen.name) == name
    assert chosen is None or len(chosen.match_labels(labels)) == marker_count

"""Units, axes and handedness of files: what is followed, what is corrected with a note, and what is refused with an option."""

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io import capture
from mocapfix.io.conventions import Convention, DeclaredConvention, decide_convention
from mocapfix.io.coordinates import METRES_PER_UNIT, ROTATIONS_TO_Y_UP
from mocapfix.model.take import TableLayout
from mocapfix.options import ReadOptions
from tests.io.test_coordinates import LABELS, LEGS, MOTIONS, build_points

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
with_data = pytest.mark.skipif(not SHARED.is_dir(), reason="no captures beside the repository")
PERMUTATIONS = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
]
FACTORS = (1000.0, 100.0, 10.0, 0.1, 0.001, 25.4)
FULL_BODIES = (
    "c3d/HDM_bd_05-01_01_120.c3d", "c3d/JA1Gait35.c3d", "c3d/Movement_trial.c3d", "c3d/PiG_Calibration-FlatFoot-Hole.c3d",
    "c3d/PiG_Motion-FlatFoot-Hole.c3d", "c3d/Qualisys.c3d", "c3d/hockey_whole_body.c3d", "c3d/squat.c3d",
    "c3d/tennis_serve_motive.c3d", "c3d/tennis_serve_motive_nan.c3d", "c3d/walking2.c3d", "cmu/01_01.c3d", "cmu/02_01.c3d",
    "cmu/02_05.c3d", "cmu/05_13.c3d", "cmu/06_01.c3d", "cmu/85_02.c3d", "csv/Sample_Static.csv", "trc/Gait.trc",
    "trc/ballet_reduced.trc", "trc/crlf.trc", "trc/dataWithBlanksForMissingMarkers.trc", "trc/subject02_running.trc",
    "trc/walk_free_01.trc",
)  # fmt: skip


def decide(motion, labels=LABELS, declared=None, **options) -> Convention:
    """Return the convention of a file of markers in metres."""
    declared = declared or DeclaredConvention(1.0)
    return decide_convention(Path("walk.trc"), build_points(labels, motion), declared, ReadOptions(**options))


def is_upright(convention: Convention, motion_file, motion) -> bool:
    """Return whether positions in the file are those of the motion, but for a turn about the vertical and the place."""
    found, wanted = (each - each[0].mean(0) for each in (convention.apply(motion_file.copy()), motion))
    lengths = [np.linalg.norm(each[..., [0, 2]], axis=-1) for each in (found, wanted)]
    chirality = [np.sign(np.linalg.det(each[0, [0, 6, 14]])) for each in (found, wanted)]
    return np.allclose(found[..., 1], wanted[..., 1]) and np.allclose(*lengths) and chirality[0] == chirality[1]


@pytest.mark.parametrize("declared_axis", ["", "X", "Y", "Z"])
@pytest.mark.parametrize("motion", ["stands", "walks"])
def test_all_axes_are_upright_or_refused_as_mirrored(motion, declared_axis):
    declared = DeclaredConvention(1.0, up_axis=declared_axis, up_basis="POINT:Y_SCREEN")
    for axes in PERMUTATIONS:
        in_file = MOTIONS[motion] @ axes.T
        if np.linalg.det(axes) > 0:
            convention = decide(in_file, declared=declared)
            assert is_upright(convention, in_file, MOTIONS[motion])
            is_overruled = declared_axis != "" and convention.up_axis.letter[-1] != declared_axis
            assert bool(convention.notes) == (is_overruled or convention.up_axis.letter.startswith("-"))
        else:
            with pytest.raises(ReadError, match=r"left-handed, or all labels .* exchanged: --mirror"):
                decide(in_file, declared=declared)
            assert is_upright(decide(in_file, declared=declared, mirror=True), in_file, MOTIONS[motion])
            assert np.linalg.det(decide(in_file, declared=declared, accept_contradictions=True).rotation_y_up_file) == 1


@pytest.mark.parametrize("prefix", ["A_", "A-", "Jim.", "Jim_1_", "A:"])
def test_labels_with_subjects_show_units_and_handedness(prefix):
    labels = [f"{prefix}{label}" for label in LABELS]
    with pytest.raises(ReadError, match="left-handed"):
        decide(MOTIONS["walks"] * [1.0, 1.0, -1.0], labels)
    assert decide(MOTIONS["walks"] * 1000, labels).unit_m == pytest.approx(0.001)


def test_props_with_more_markers_than_the_person_hide_no_evidence():
    with_props = np.concatenate([np.full((240, 20, 3), 0.5), MOTIONS["walks"]], axis=1)
    labels = [*(f"Box:Corner{m}" for m in range(20)), *(f"Jim:{label}" for label in LABELS)]
    with pytest.raises(ReadError, match="left-handed"):
        decide(with_props * [-1.0, 1.0, 1.0], labels)
    assert decide(with_props * 1000, labels).unit_m == pytest.approx(0.001)


def test_the_person_with_the_most_labels_counts():
    both = np.concatenate([MOTIONS["walks"], MOTIONS["walks"][:, :5] + [0.0, 40.0, 0.0]], axis=1)
    assert decide(both, [*(f"A_{label}" for label in LABELS), *(f"B_{label}" for label in LABELS[:5])]).notes == ()


def test_mirroring_a_right_handed_file_is_refused():
    with pytest.raises(ReadError, match=r"--mirror makes it left-handed.*Leave it out"):
        decide(MOTIONS["walks"], mirror=True)
    assert np.linalg.det(decide(MOTIONS["walks"], mirror=True, accept_contradictions=True).rotation_y_up_file) == -1


@pytest.mark.parametrize("axis", "YZ")
@pytest.mark.parametrize("motion", ["lies prone", "lies supine"])
def test_a_person_who_lies_is_not_turned(motion, axis):
    in_file = MOTIONS[motion] @ ROTATIONS_TO_Y_UP[axis]
    declared = DeclaredConvention(1.0, up_axis=axis, up_basis="POINT:Y_SCREEN")
    assert decide(in_file, declared=declared).up_axis.letter == axis
    assert decide(in_file, up_axis=axis).up_axis.letter == axis


def test_a_person_who_crawls_or_rolls_is_not_turned():
    crawl, roll = MOTIONS["lies prone"].copy(), MOTIONS["lies prone"].copy()
    way = np.linspace(0, 3, len(crawl))
    crawl[..., 2] += way[:, None]
    middle = roll.mean(1, keepdims=True)
    turn = way / 0.2
    offset = roll - middle
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    rolled = np.stack([cos * offset[..., 0] - sin * offset[..., 1], sin * offset[..., 0] + cos * offset[..., 1]], -1)
    roll[..., :2] = middle[..., :2] + rolled
    roll[..., 0] -= way[:, None]
    declared = DeclaredConvention(1.0, up_axis="Y", up_basis="POINT:Y_SCREEN")
    assert decide(crawl, declared=declared).up_axis.letter == "Y"
    assert decide(roll, declared=declared).up_axis.letter == "Y"


def test_a_given_up_axis_that_the_standing_feet_contradict_is_refused():
    with pytest.raises(ReadError, match=r"--up Z contradicts its markers.*along Y\. Leave out --up"):
        decide(MOTIONS["walks"], up_axis="Z")
    assert decide(MOTIONS["walks"], up_axis="Z", accept_contradictions=True).up_axis.letter == "Z"
    assert decide(MOTIONS["walks"]).up_axis.letter == "Y"


def test_someone_on_a_box_needs_the_up_axis_where_the_file_contradicts_it():
    on_box = MOTIONS["stands"] + [0.0, 0.7, 0.0]
    declared = DeclaredConvention(1.0, up_axis="Z", up_basis="POINT:Y_SCREEN")
    with pytest.raises(ReadError, match=r"declares Z to be vertical.*--up Y, or --up Z if the person lies"):
        decide(on_box, declared=declared)
    assert decide(on_box, declared=declared, up_axis="Y").up_axis.letter == "Y"
    assert decide(on_box, declared=declared, up_axis="Z").up_axis.letter == "Z"


@pytest.mark.parametrize("markers", [range(len(LABELS)), LEGS], ids=["body", "legs"])
@pytest.mark.parametrize("factor", [1000.0, 100.0, 10.0, 25.4, 1e-3, 1e-2, 1e-1, 1 / 25.4])
def test_confused_units_are_corrected_with_a_note(factor, markers):
    motion, labels = MOTIONS["walks"][:, list(markers)], [LABELS[m] for m in markers]
    assert decide(motion, labels).notes == ()
    convention = decide(motion * factor, labels)
    assert convention.unit_m == pytest.approx(1 / factor)
    assert decide(motion * factor, labels, accept_contradictions=True).unit_m == convention.unit_m
    assert "--unit sets the unit" in convention.notes[0]
    np.testing.assert_allclose(convention.apply(motion * factor), decide(motion, labels).apply(motion.copy()), atol=1e-9)


@pytest.mark.parametrize(("factor", "unit"), [(4.0, ""), (1 / 0.3048, "ft"), (1e4, ""), (1e-4, "")])
def test_a_size_that_no_usual_error_explains_is_refused_and_the_unit_settles_it(factor, unit):
    with pytest.raises(ReadError, match=r"the distance of head and feet is .* --unit, one of mm, cm, m, in, ft"):
        decide(MOTIONS["walks"] * factor)
    assert decide(MOTIONS["walks"] * factor, accept_contradictions=True).unit_m == 1.0
    if unit:
        assert decide(MOTIONS["walks"] * factor, unit=unit).unit_m == METRES_PER_UNIT[unit]


def test_a_child_and_a_giant_keep_their_unit_with_a_note():
    for factor in (0.4, 1.4):
        convention = decide(MOTIONS["stands"] * factor)
        assert convention.unit_m == 1.0
        assert "if that is wrong, give the unit with --unit" in convention.notes[0]


@with_data
@pytest.mark.parametrize("name", FULL_BODIES)
def test_captures_in_a_sample_of_all_axes_and_units(name):
    """Every capture in two right-handed and two left-handed axes; `mocapfix bench conventions` measures all 48."""
    take = capture.read_take(SHARED / "captures" / name)
    assert take.layout is not None
    declared = DeclaredConvention(take.layout.unit_m)
    in_file = take.markers @ take.layout.rotation_y_up_file
    rng = np.random.default_rng(len(name))
    for axes in [PERMUTATIONS[i] for i in rng.choice(48, 4, replace=False)]:
        arguments = Path(name), build_points(take.labels, in_file @ axes.T, take.rate), declared
        if np.linalg.det(axes) < 0:
            with pytest.raises(ReadError, match="--mirror"):
                decide_convention(*arguments, ReadOptions())
        convention = decide_convention(*arguments, ReadOptions(mirror=bool(np.linalg.det(axes) < 0)))
        vertical = convention.rotation_y_up_file @ axes @ take.layout.rotation_y_up_file.T @ [0, 1, 0]
        np.testing.assert_allclose(vertical, [0, 1, 0], atol=1e-12)
    for factor in FACTORS:
        found = decide_convention(Path(name), build_points(take.labels, in_file * factor, take.rate), declared, ReadOptions())
        assert found.unit_m == pytest.approx(take.layout.unit_m / factor)


@with_data
def test_captures_in_their_own_axes_have_no_contradiction():
    """No sound capture is refused, turned or measured in another unit."""
    for path in sorted((SHARED / "captures").glob("*/*.[ct]*")):
        sentences: tuple[str, ...] = ()
        try:
            sentences = capture.read_capture(path).notes
        except ReadError as error:  # damaged files
            sentences = (str(error),)
        assert not [each for each in sentences if "--unit" in each or "--up" in each or "--mirror" in each], path


@with_data
@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("c3d_units_m_values_mm.c3d", "the distance of head and feet is 1,400 m; coordinates are taken as mm"),
        ("c3d_units_mete.c3d", ""),
        ("c3d_yscreen_wrong.c3d", "declares Y to be vertical"),
        ("trc_upside_down_minus_y.trc", "The Y axis of the file points down"),
    ],
)
def test_odd_files_are_upright_and_in_scale(tmp_path, name, note):
    take = capture.read_take(shutil.copy(SHARED / "cases" / name, tmp_path))
    head, heel = (np.nanmedian(take.markers[:, take.labels.index(label)], axis=0) for label in ("LFHD", "LHEE"))
    assert 1.4 < head[1] - heel[1] < 1.8
    assert note in " ".join(take.notes)


def test_numbers_in_a_corrected_unit_resolve_a_hundredth_of_a_millimetre(tmp_path):
    names = ["Time", *(f"{label}_{axis}_mm" for label in LABELS for axis in "XYZ")]
    rows = [[f"{t / 60:.4f}", *(f"{value:.2f}" for value in row.ravel())] for t, row in enumerate(MOTIONS["walks"])]
    (tmp_path / "in_metres.csv").write_text("\n".join(",".join(row) for row in [names, *rows]) + "\n", encoding="utf-8")
    layout = capture.read_take(tmp_path / "in_metres.csv").layout
    assert isinstance(layout, TableLayout)
    assert layout.unit_m == 1.0
    assert layout.number_format == ".5f"

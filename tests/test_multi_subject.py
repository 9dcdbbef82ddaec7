"""Several people in one take: whose bodies it shows, each cleaned as if alone, and one file for all."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mocapfix import multi_subject, pipeline, synthetic
from mocapfix.changes import UnfilledRun
from mocapfix.errors import SceneError, TakeError, WriteError
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.files.layouts import C3dLayout
from mocapfix.marker_sets import load_marker_set
from mocapfix.read import capture
from mocapfix.report.review_file import read_review_files
from mocapfix.result import CleaningResult
from mocapfix.take import Take
from mocapfix.options import OutputOptions
from tests.conftest import as_c3d

CMU41 = load_marker_set("cmu41").labels
FEET = ("LANK", "LHEE", "LTOE", "LMT5", "LKNE")  # a part of a body
BESIDE = np.array([2.0, 0, 0])  # metres
FIRST = 31
FRAMES = 120


def of_people(*names: str, more: tuple[str, ...] = ()) -> tuple[str, ...]:
    return (*(f"{name}:{label}" for name in names for label in CMU41), *more)


def labelled(labels, seen=None, subjects=()) -> Take:
    markers = np.random.default_rng(0).normal(size=(4, len(labels), 3))
    if seen is not None:
        markers[:, ~seen] = np.nan
    return Take(markers, tuple(labels), 120.0, subject_names=subjects, point_columns=np.arange(len(labels)) + 7)


# whose they are


def test_a_label_says_whose_it_is_and_so_does_a_file_of_one_person():
    assert labelled(("Jim:LFHD", "A:B:C7", "T10"), subjects=("Jim",)).marker_subjects == ("Jim", "A:B", "")
    assert labelled(("LFHD", "C7"), subjects=("Jim",)).marker_subjects == ("Jim", "Jim")
    assert labelled(("LFHD", "C7"), subjects=("Jim", "Ann")).marker_subjects == ("", "")


def test_whole_bodies_are_people_and_what_is_part_of_one_is_not():
    labels = of_people("Jim", "Ann", more=(*(f"Bob:{label}" for label in FEET), "box:1", "C7"))
    assert multi_subject.find_whole_bodies(labelled(labels)) == ("Jim", "Ann")
    assert multi_subject.find_whole_bodies(labelled(labels), load_marker_set("plug-in-gait39")) == ()
    assert multi_subject.find_whole_bodies(labelled(CMU41)) == ("",)


def test_who_is_never_seen_is_not_there():
    seen = np.arange(2 * len(CMU41)) < len(CMU41)
    assert multi_subject.find_whole_bodies(labelled(of_people("Jim", "Ann"), seen)) == ("Jim",)


@pytest.mark.parametrize("labels", [CMU41, of_people("Jim", more=("box:1", "box:2", "box:3")), ("box:1", "Jim:2")])
def test_a_take_of_one_person_or_none_stays_as_it_is(labels):
    take = labelled(labels)
    assert multi_subject.split_subjects(take) == (take,)


def test_each_of_several_has_a_part_and_so_has_what_is_nobodys():
    labels = of_people("Jim", "Ann", more=("box:1", "Ann2:LFHD", "loose"))
    jim, ann, others = multi_subject.split_subjects(labelled(labels))
    assert [part.subject_name for part in (jim, ann, others)] == ["Jim", "Ann", "others"]
    assert (*jim.labels, *ann.labels, *others.labels) == labels
    np.testing.assert_array_equal(
        np.concatenate([jim.point_columns, ann.point_columns, others.point_columns]), np.arange(len(labels)) + 7
    )
    assert (jim.name, replace(jim, path=None).output_stem) == ("the take (Jim)", "take.Jim")


def test_too_little_to_be_placed_is_left_alone_and_told():
    jim, ann = multi_subject.split_subjects(labelled(of_people("Jim", "Ann", more=("stick:1", "stick:2"))))
    assert [len(part.labels) for part in (jim, ann)] == [41, 41]
    assert all("left as they are: stick:1, stick:2." in part.notes[0] for part in (jim, ann))


@pytest.mark.parametrize("said", ["Ann", "ann", "Ann:"])
def test_one_is_found_by_the_name_as_people_write_it(said):
    (ann,) = multi_subject.split_subjects(labelled(of_people("Jim", "Ann")), subject_prefix=said)
    assert (ann.subject_name, set(ann.marker_subjects)) == ("Ann", {"Ann"})
    assert ann.notes == ("Only Ann's markers were looked at: the rest of the file is as it was.",)


def test_the_only_name_there_is_changes_nothing():
    take = labelled(of_people("Jim"))
    assert multi_subject.split_subjects(take, subject_prefix="Jim") == (take,)
    assert multi_subject.split_subjects(labelled(CMU41, subjects=("Jim",)), subject_prefix="Jim")[0].subject_name == ""


def test_a_name_that_nobody_has_is_a_sentence_with_those_there_are():
    with pytest.raises(TakeError, match="nobody in it is called 'Bob'; its markers are those of Jim, box"):
        multi_subject.split_subjects(labelled((*of_people("Jim"), "box:1", "C7")), subject_prefix="Bob")
    with pytest.raises(TakeError, match="its labels carry no names"):
        multi_subject.split_subjects(labelled(CMU41), subject_prefix="Bob")


def test_files_of_people_are_named_so_that_any_system_takes_them():
    take = replace(labelled(CMU41), subject_name='A/B: "C"')
    assert take.output_stem == "take.A_B_ _C_"


# all together again


def test_what_was_found_of_each_is_told_of_the_whole():
    """Markers of Ann and Jim by turns, and one unlabelled trajectory: indices into a part become indices into the take."""
    take = labelled(("Ann:A", "Jim:A", "Ann:B", "Jim:B"))
    loose = Take(np.ones((4, 1, 3)), ("*1",), 120.0, point_columns=np.array([3]))
    take = replace(take, unlabelled=loose)
    ann, jim = (take.extract_markers(np.flatnonzero(np.array(take.marker_subjects) == name), name) for name in ("Ann", "Jim"))
    taken = replace(jim, unlabelled=replace(loose, markers=loose.markers * np.nan))
    mended = taken.markers.copy()
    mended[1, 0] = 9.0
    after = replace(taken, markers=mended, sample_sd=np.where(mended[..., 0] == 9, 0.01, np.nan))
    none = (None, None, None, None)
    of_ann = CleaningResult(
        ann,
        ann,
        ann,
        Faults((Fault("swap", 0, 1, 2, 0.1, "", other_markers=(1,)),)),
        (),
        (UnfilledRun(1, 0, 3, "why"),),
        (1,),
        *none,
        {"a": 1},
    )
    piece = Fragment("fragment", 1, 0, 3, 0.0, "", donor=2, relation="continues")
    of_jim = CleaningResult(jim, taken, after, Faults((piece,)), (), (), (), *none, {"j": 1})

    whole = multi_subject.merge_results(take, (of_ann, of_jim))
    assert whole.take.unlabelled is not None
    assert whole.take.sample_sd is not None
    assert [(fault.markers, getattr(fault, "donor", None)) for fault in whole.faults.items] == [((0, 2), None), ((3,), 4)]
    assert (whole.unfilled_runs, whole.fragment_donors) == ((UnfilledRun(2, 0, 3, "why"),), (2,))
    np.testing.assert_array_equal(np.argwhere(whole.take.markers != take.markers), [[1, 1, axis] for axis in range(3)])
    np.testing.assert_array_equal(np.argwhere(~np.isnan(whole.take.sample_sd)), [[1, 1]])
    assert not whole.take.unlabelled.visible.any()
    assert whole.report == {"people": {"Ann": {"a": 1}, "Jim": {"j": 1}}}


# the whole way


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """-> a take of Jim, Ann and a box, and two of Jim and Ann alone, all with the same gaps"""
    folder = tmp_path_factory.mktemp("people")
    jim, ann = (synthetic.compose_take(seed=seed, seconds=FRAMES / 120).marker_positions for seed in (3, 4))
    ann = ann + BESIDE
    for markers, gaps in ((jim, ("RELB", "LKNE")), (ann, ("LFIN", "RSHN"))):
        for first, label in zip((30, 70), gaps, strict=True):
            markers[first : first + 25, CMU41.index(label)] = np.nan
    around = 0.3 * np.sin(np.arange(FRAMES) / 40)[:, None, None]
    box = around + np.array([[1, 0.5, 1], [1.3, 0.5, 1], [1, 0.5, 1.3], [1.2, 0.9, 1.1]]) + np.zeros((FRAMES, 4, 3))
    box[60:75, 2] = np.nan
    labels = of_people("Jim", "Ann", more=tuple(f"box:{corner}" for corner in "abcd"))
    (folder / "two.c3d").write_bytes(as_c3d(np.concatenate([jim, ann, box], 1), labels, first=FIRST))
    for name, markers in (("Jim", jim), ("Ann", ann)):
        (folder / f"{name}.c3d").write_bytes(as_c3d(markers, of_people(name), first=FIRST))
    return folder


@pytest.fixture(scope="module")
def two(files):
    result = pipeline.clean(files / "two.c3d")
    return result, result.write(files / "two.mocapfix")


def test_everybody_is_cleaned_and_written_by_name(files, two):
    result, outputs = two
    assert [each.input_take.subject_name for each in result.subject_results] == ["Jim", "Ann", "others"]
    everyones = ("changes.yaml", "report.json", "report.html", "rrd")
    kinds = {f"{name}.{kind}" for name in ("Jim", "Ann", "others") for kind in everyones}
    kinds |= {f"{name}.{kind}" for name in ("Jim", "Ann") for kind in ("bvh", "subject.yaml")} | {"c3d"}
    assert set(outputs) == kinds
    assert {path.name for path in (files / "two.mocapfix").iterdir()} == {f"two.{kind}" for kind in kinds}
    said = json.loads(outputs["Ann.report.json"].read_text())
    assert (said["take"]["file"], said["take"]["person"], said["take"]["markers"]) == ("two.c3d", "Ann", 41)
    assert [fill["missing_before"] for each in result.subject_results for fill in [each.report["fill"]]] == [50, 50, 15]
    assert all(each.report["fill"]["left_empty"] == 0 for each in result.subject_results)
    assert "two.c3d (Ann)" in outputs["Ann.report.html"].read_text()


@pytest.mark.parametrize("name", ["Jim", "Ann"])
def test_each_outcome_is_that_of_cleaning_the_persons_own_file(files, two, name, tmp_path):
    _, outputs = two
    alone = pipeline.clean(files / f"{name}.c3d").write(tmp_path)
    together, own = capture.read_capture(outputs["c3d"]), capture.read_capture(alone["c3d"])
    which = np.flatnonzero(np.array(together.marker_subjects) == name)
    np.testing.assert_allclose(together.markers[:, which], own.markers, atol=1e-6)
    bvh, wanted = (np.array(path.read_text().split()[-FRAMES * 96 :], float) for path in (outputs[f"{name}.bvh"], alone["bvh"]))
    np.testing.assert_allclose(bvh, wanted, atol=1e-3)  # centimetres and degrees


def test_one_file_holds_everybodys_changes_and_no_others(files, two):
    result, outputs = two
    before, after = capture.read_capture(files / "two.c3d"), capture.read_capture(outputs["c3d"])
    assert after.visible.all()
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    old, new = (layout.view_words(path.read_bytes()) for path in (files / "two.c3d", outputs["c3d"]))
    np.testing.assert_array_equal((old != new).any(-1), ~before.visible)
    np.testing.assert_allclose(after.markers, result.take.markers, atol=1e-6)


def test_one_of_them_alone_leaves_the_rest_as_it_is(files, two, tmp_path):
    everybody, _ = two
    result = pipeline.clean(files / "two.c3d", subject_prefix="Jim", subject=everybody.subject_results[0].subject)
    outputs = result.write(tmp_path)
    assert {path.name for path in outputs.values()} >= {"two.c3d", "two.Jim.bvh", "two.Jim.report.json"}
    before, after = capture.read_capture(files / "two.c3d"), capture.read_capture(outputs["c3d"])
    jims = np.array(before.marker_subjects) == "Jim"
    assert after.visible[:, jims].all()
    np.testing.assert_array_equal(after.markers[:, ~jims], before.markers[:, ~jims])


def test_decisions_are_given_back_in_a_file_for_each(files, two, tmp_path):
    result, outputs = two
    text = outputs["Ann.changes.yaml"].read_text()
    assert text.count("decision: accept") == 2
    edited = tmp_path / "mine.yaml"
    edited.write_text(text.replace("decision: accept", "decision: reject", 1))
    bodies = [each.input_take for each in result.subject_results]
    of_jim, of_ann, of_others = read_review_files([edited, outputs["Jim.changes.yaml"]], bodies)
    assert (len(of_jim), len(of_ann), len(of_others)) == (0, 1, 0)
    assert bodies[1].labels[of_ann[0].markers[0]] in ("Ann:LFIN", "Ann:RSHN")
    with pytest.raises(SceneError, match=r"mine\.yaml is for two\.c3d \(Ann\) as well; give one of them"):
        read_review_files([edited, outputs["Ann.changes.yaml"]], bodies)
    with pytest.raises(SceneError, match=r"is for two\.c3d \(Ann\), not for two\.c3d \(Jim\); use the review file of this take\."):
        read_review_files([edited], bodies[:1])
    with pytest.raises(SceneError, match=r"\(Ann\), not for two\.c3d; .*, or select the subject with --subject-prefix\."):
        read_review_files([edited], [result.input_take])


def test_a_subject_is_one_persons(files, two):
    with pytest.raises(TakeError, match="shows Jim and Ann, and a subject is one person; say whose it is with --subject-prefix"):
        pipeline.clean(files / "two.c3d", subject=two[0].subject_results[0].subject)


def test_calibration_asks_whose_bones(files):
    with pytest.raises(TakeError, match="shows Jim and Ann; say whose bones are wanted"):
        pipeline.calibrate_takes([files / "two.c3d"])
    assert pipeline.calibrate_takes([files / "two.c3d"], subject_prefix="Ann").labels == CMU41


def test_what_is_there_already_is_not_replaced_and_nothing_is_written(files, two, tmp_path):
    (tmp_path / "two.Ann.bvh").write_text("mine")
    with pytest.raises(WriteError, match=r"two\.Ann\.bvh: is there already"):
        two[0].write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["two.Ann.bvh"]


def test_what_else_is_asked_for_is_everybodys_own_but_the_c3d_which_is_one(files, two, tmp_path):
    outputs = two[0].write(tmp_path, options=OutputOptions(extra_formats=("npz", "c3d", "amc"), rigs=("blender",)))
    assert {kind for kind in outputs if kind.endswith(("c3d", "npz", "asf", "amc", "blender.bvh"))} == {
        "c3d", "others.npz", *(f"{name}.{kind}" for name in ("Jim", "Ann") for kind in ("npz", "asf", "amc", "blender.bvh")),
    }  # fmt: skip
    with np.load(outputs["Ann.npz"]) as file:
        assert set(file["labels"]) == set(of_people("Ann"))
        assert np.abs(file["root"][:, 0] - BESIDE[0]).max() < 1.5


def test_people_whose_files_would_have_one_name_are_a_sentence(files, two, tmp_path):
    jim = two[0].subject_results[0]
    both = replace(two[0], subject_results=(jim, replace(jim, input_take=replace(jim.input_take, subject_name="JIM"))))
    with pytest.raises(WriteError, match="would have the same name"):
        both.write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_a_file_cannot_hold_is_left_empty_in_the_report_of_whose_it_is(files, two, tmp_path):
    jim, ann, others = two[0].subject_results
    markers = ann.take.markers.copy()
    markers[5, 3] = 1e4  # metres: read back, it would be what Cortex writes for a marker that is not there
    far = replace(ann, take=ann.take.replace_markers(markers, np.where(markers[..., 0] == 1e4, 0.01, ann.take.sample_sd)))
    outputs = multi_subject.merge_results(two[0].input_take, (jim, far, others)).write(tmp_path)
    fills = {name: json.loads(outputs[f"{name}.report.json"].read_text())["fill"] for name in ("Jim", "Ann", "others")}
    assert [fill["left_empty"] for fill in fills.values()] == [0, 1, 0]
    (left,) = fills["Ann"]["unfilled"]
    assert (left["marker"], left["first"], left["last"]) == (ann.input_take.labels[3], FIRST + 5, FIRST + 5)


def test_the_command_line_tells_of_each(files, two, mocapfix, tmp_path):
    status, out, _ = mocapfix("inspect", files / "two.c3d", "--subject-prefix", "box")
    assert (status, " ".join(out.split()).startswith("two.c3d (box): 4 markers, frames 31 to 150 at 120 Hz.")) == (0, True)
    jims, anns = (tmp_path / f"{name}.yaml" for name in ("jim", "ann"))
    jims.write_text(two[1]["Jim.changes.yaml"].read_text())
    anns.write_text(two[1]["Ann.changes.yaml"].read_text().replace("decision: accept", "decision: reject", 1))
    given = ("--changes", jims, "--changes", anns, "--out", tmp_path / "out", "--json")
    status, out, _ = mocapfix("clean", files / "two.c3d", *given)
    told = {each["take"]["person"]: each["fill"]["left_empty"] for each in json.loads(out)}
    assert (status, told) == (0, {"Jim": 0, "Ann": 25, "others": 0})
    status, out, err = mocapfix("clean", files / "two.c3d", "--subject-prefix", "Bob", "--out", tmp_path / "none")
    assert (status, out) == (1, "")
    assert "its markers are those of Jim, Ann, box" in " ".join(err.split())
    assert not (tmp_path / "none").exists()

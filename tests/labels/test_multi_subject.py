"""Takes of several subjects: whole bodies are found, each is cleaned as if it were alone, and one file contains all of them."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from mocapfix import pipeline
from mocapfix.errors import SceneError, TakeError, WriteError
from mocapfix.io.capture import read_take
from mocapfix.io.changes_file import NO_REVIEW, SWAP_REASON, read_changes_files
from mocapfix.io.yaml_files import ChangesFileModel
from mocapfix.labels import multi_subject
from mocapfix.labels.multi_subject import SubjectExchanges, correct_subject_labels
from mocapfix.labels.requested_labels import label_take
from mocapfix.model.changes import UnfilledRun
from mocapfix.model.faults import Fault, Faults, Fragment
from mocapfix.model.stage_timer import StageTimer, omit_stage_times
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import DEFAULT_READ_OPTIONS, CleanOptions, OutputOptions
from mocapfix.result import CleaningResult, merge_results
from mocapfix.subject import library
from mocapfix.subject.library import SubjectChoice, find_subject_prefixes, load_marker_set, load_shipped_marker_sets
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d

CMU41 = load_marker_set("cmu41").labels
FOOT = ("LANK", "LHEE", "LTOE", "LMT5", "LKNE")  # a part of a body
SUBJECT_OFFSET_M = np.array([2.0, 0, 0])
FIRST_FRAME = 31
FRAMES = 120


def build_labels(*names: str, more: tuple[str, ...] = ()) -> tuple[str, ...]:
    return (*(f"{name}:{label}" for name in names for label in CMU41), *more)


def build_take(labels, visible=None, subject_names=()) -> Take:
    markers = np.random.default_rng(0).normal(size=(4, len(labels), 3))
    if visible is not None:
        markers[:, ~visible] = np.nan
    point_columns = np.arange(len(labels)) + 7
    return Take(markers, tuple(labels), 120.0, subject_names=subject_names, point_columns=point_columns)


# subjects of the markers


def test_the_subject_is_in_the_label_or_is_the_only_one_of_the_file():
    assert build_take(("Jim:LFHD", "A:B:C7", "T10"), subject_names=("Jim",)).marker_subjects == ("Jim", "A:B", "")
    assert build_take(("LFHD", "C7"), subject_names=("Jim",)).marker_subjects == ("Jim", "Jim")
    assert build_take(("LFHD", "C7"), subject_names=("Jim", "Ann")).marker_subjects == ("", "")


@pytest.mark.parametrize("separator", ["_", "-", "."])
@pytest.mark.parametrize("names", [("A",), ("A", "B"), ("Jim_1", "Jim_2"), ("L", "R")], ids="+".join)
def test_names_of_subjects_may_end_in_other_separators(names, separator):
    more = (f"box{separator}1", f"box{separator}2", "loose")
    labels = (*(f"{name}{separator}{label}" for name in names for label in CMU41), *more)
    take = label_take(build_take(labels), SubjectChoice(None, None), DEFAULT_READ_OPTIONS)
    assert take.labels == labels
    assert take.marker_subjects == (*(name for name in names for _ in CMU41), "", "", "")
    assert take.bare_labels == (*CMU41 * len(names), *more)
    parts = multi_subject.split_subjects(take)
    assert [part.subject_name for part in parts] == ([*names, "others"] if len(names) > 1 else [""])
    (selected,) = multi_subject.split_subjects(take, subject_prefix=names[-1])
    assert selected.bare_labels == CMU41
    assert set(CMU41) == set(load_marker_set("cmu41").match_labels(selected.labels))


@pytest.mark.parametrize("marker_set", load_shipped_marker_sets(), ids=lambda each: each.name)
def test_words_for_sides_and_parts_of_the_body_are_no_subjects(marker_set):
    for labels in (marker_set.labels, *_spell(marker_set)):
        assert find_subject_prefixes(labels) == ()
        assert find_subject_prefixes(labels[: len(labels) // 2]) == ()
        assert find_subject_prefixes(tuple(f"A_{label}" for label in labels)) == ("A_",)


def _spell(marker_set):
    """Return the labels of a set with their aliases in place of the markers' names, as far as they have any."""
    count = max(len(aliases) for aliases in marker_set.aliases)
    named = list(zip(marker_set.labels, marker_set.aliases, strict=True))
    return [tuple(aliases[n] if n < len(aliases) else label for label, aliases in named) for n in range(count)]


@pytest.mark.parametrize(
    "labels",
    [
        ("L_ANKLE", "R_ANKLE", "Left_Knee", "Right_Knee", "V_Sacral", "R.Heel", "L.Heel", "L-ASIS", "R-ASIS", "L_TOE", "R_TOE"),
        tuple(f"Marker_{n}" for n in range(60)),
        tuple(f"{side}_{name}" for side in "LR" for name in ("HEE", "TOE", "ANK", "KNE", "THI", "TIB", "ASI", "PSI")),
        ("Jim:L_ANKLE", *(f"A_{label}" for label in CMU41)),
    ],
    ids=["sides", "numbers", "legs", "colons"],
)
def test_other_separators_are_parts_of_labels(labels):
    assert find_subject_prefixes(labels) == ()


def test_whole_bodies_are_subjects_and_parts_of_bodies_are_not():
    labels = build_labels("Jim", "Ann", more=(*(f"Bob:{label}" for label in FOOT), "box:1", "C7"))
    assert multi_subject.find_bodies(build_take(labels)) == ("Jim", "Ann")
    assert multi_subject.find_bodies(build_take(labels), load_marker_set("qualisys-sports")) == ()
    assert multi_subject.find_bodies(build_take(CMU41)) == ("",)


def test_a_subject_that_is_never_visible_is_not_found():
    visible = np.arange(2 * len(CMU41)) < len(CMU41)
    assert multi_subject.find_bodies(build_take(build_labels("Jim", "Ann"), visible)) == ("Jim",)


@pytest.mark.parametrize("labels", [CMU41, build_labels("Jim", more=("box:1", "box:2", "box:3")), ("box:1", "Jim:2")])
def test_a_take_of_at_most_one_subject_is_not_split(labels):
    take = build_take(labels)
    assert multi_subject.split_subjects(take) == (take,)


def test_several_subjects_and_the_unassigned_markers_are_split():
    labels = build_labels("Jim", "Ann", more=("box:1", "Ann2:LFHD", "loose"))
    jim, ann, others = multi_subject.split_subjects(build_take(labels))
    assert [take.subject_name for take in (jim, ann, others)] == ["Jim", "Ann", "others"]
    assert (*jim.labels, *ann.labels, *others.labels) == labels
    columns = np.concatenate([jim.point_columns, ann.point_columns, others.point_columns])
    np.testing.assert_array_equal(columns, np.arange(len(labels)) + 7)
    assert (jim.name, replace(jim, path=None).output_stem) == ("the take (Jim)", "take.Jim")


def test_too_few_unassigned_markers_are_left_unchanged_with_a_note():
    jim, ann = multi_subject.split_subjects(build_take(build_labels("Jim", "Ann", more=("stick:1", "stick:2"))))
    assert [len(take.labels) for take in (jim, ann)] == [41, 41]
    assert all("left unchanged: stick:1, stick:2." in take.notes[0] for take in (jim, ann))


@pytest.mark.parametrize("prefix", ["Ann", "ann", "Ann:"])
def test_a_subject_is_selected_by_its_name(prefix):
    (ann,) = multi_subject.split_subjects(build_take(build_labels("Jim", "Ann")), subject_prefix=prefix)
    assert (ann.subject_name, set(ann.marker_subjects)) == ("Ann", {"Ann"})
    assert ann.notes == ("Only the markers of Ann were cleaned: the rest of the file is unchanged.",)


def test_selecting_the_only_subject_changes_nothing():
    take = build_take(build_labels("Jim"))
    assert multi_subject.split_subjects(take, subject_prefix="Jim") == (take,)
    (unnamed,) = multi_subject.split_subjects(build_take(CMU41, subject_names=("Jim",)), subject_prefix="Jim")
    assert unnamed.subject_name == ""


def test_an_unknown_subject_is_an_error_that_lists_the_known_ones():
    with pytest.raises(TakeError, match="has no subject 'Bob'; its subjects are Jim, box"):
        multi_subject.split_subjects(build_take((*build_labels("Jim"), "box:1", "C7")), subject_prefix="Bob")
    with pytest.raises(TakeError, match="its labels name no subjects"):
        multi_subject.split_subjects(build_take(CMU41), subject_prefix="Bob")


def test_names_of_output_files_are_valid_on_every_system():
    take = replace(build_take(CMU41), subject_name='A/B: "C"')
    assert take.output_stem == "take.A_B_ _C_"


# merging


def build_result(before, relabelled, after, faults, unfilled_runs, donors, report):
    return CleaningResult(
        input_take=before,
        relabelled_take=relabelled,
        take=after,
        faults=Faults(faults),
        changes=(),
        unfilled_runs=unfilled_runs,
        fragment_donors=donors,
        subject=None,
        motion=None,
        joint_position_world=None,
        residual_m=None,
        report=report,
    )


def test_indices_of_subjects_become_indices_of_the_whole_take():
    """The take has markers of Ann and Jim alternately, and one unlabelled trajectory."""
    take = build_take(("Ann:A", "Jim:A", "Ann:B", "Jim:B"))
    unlabelled = Take(np.ones((4, 1, 3)), ("*1",), 120.0, point_columns=np.array([3]))
    take = replace(take, unlabelled=unlabelled)
    ann, jim = (take.extract_markers(np.flatnonzero(np.array(take.marker_subjects) == name), name) for name in ("Ann", "Jim"))
    relabelled = replace(jim, unlabelled=replace(unlabelled, markers=unlabelled.markers * np.nan))
    markers = relabelled.markers.copy()
    markers[1, 0] = 9.0
    cleaned = replace(relabelled, markers=markers, sample_sd=np.where(markers[..., 0] == 9, 0.01, np.nan))
    swap = Fault("swap", 0, 1, 2, 0.1, "", other_markers=(1,))
    of_ann = build_result(ann, ann, ann, (swap,), (UnfilledRun(1, 0, 3, "reason"),), (1,), {"a": 1})
    fragment = Fragment("fragment", 1, 0, 3, 0.0, "", donor=2, relation="continues")
    of_jim = build_result(jim, relabelled, cleaned, (fragment,), (), (), {"j": 1})

    whole = merge_results(SubjectExchanges(take, take), (of_ann, of_jim))
    assert whole.take.unlabelled is not None
    assert whole.take.sample_sd is not None
    assert [(fault.markers, getattr(fault, "donor", None)) for fault in whole.faults.items] == [((0, 2), None), ((3,), 4)]
    assert (whole.unfilled_runs, whole.fragment_donors) == ((UnfilledRun(2, 0, 3, "reason"),), (2,))
    np.testing.assert_array_equal(np.argwhere(whole.take.markers != take.markers), [[1, 1, axis] for axis in range(3)])
    np.testing.assert_array_equal(np.argwhere(~np.isnan(whole.take.sample_sd)), [[1, 1]])
    assert not whole.take.unlabelled.visible.any()
    assert whole.report == {"people": {"Ann": {"a": 1}, "Jim": {"j": 1}}}


# whole files


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the folder of a take of Jim, Ann and a box, and of takes of Jim and of Ann alone with the same gaps."""
    folder = tmp_path_factory.mktemp("subjects")
    jim, ann = (compose_take(seed=seed, seconds=FRAMES / 120).marker_positions for seed in (3, 4))
    ann = ann + SUBJECT_OFFSET_M
    for markers, gaps in ((jim, ("RELB", "LKNE")), (ann, ("LFIN", "RSHN"))):
        for first, label in zip((30, 70), gaps, strict=True):
            markers[first : first + 25, CMU41.index(label)] = np.nan
    centre = 0.3 * np.sin(np.arange(FRAMES) / 40)[:, None, None]
    box = centre + np.array([[1, 0.5, 1], [1.3, 0.5, 1], [1, 0.5, 1.3], [1.2, 0.9, 1.1]]) + np.zeros((FRAMES, 4, 3))
    box[60:75, 2] = np.nan
    labels = build_labels("Jim", "Ann", more=tuple(f"box:{corner}" for corner in "abcd"))
    (folder / "two.c3d").write_bytes(build_c3d(np.concatenate([jim, ann, box], 1), labels, first=FIRST_FRAME))
    for name, markers in (("Jim", jim), ("Ann", ann)):
        (folder / f"{name}.c3d").write_bytes(build_c3d(markers, build_labels(name), first=FIRST_FRAME))
    return folder


@pytest.fixture(scope="module")
def two(files):
    result = pipeline.clean(files / "two.c3d")
    return result, result.write(files / "two.mocapfix")


def test_every_subject_has_output_files_with_its_name(files, two):
    result, outputs = two
    assert [each.input_take.subject_name for each in result.subject_results] == ["Jim", "Ann", "others"]
    common = ("changes.yaml", "report.json", "report.html", "rrd")
    suffixes = {f"{name}.{suffix}" for name in ("Jim", "Ann", "others") for suffix in common}
    suffixes |= {f"{name}.{suffix}" for name in ("Jim", "Ann") for suffix in ("bvh", "subject.yaml")} | {"c3d"}
    assert set(outputs) == suffixes
    assert {path.name for path in (files / "two.mocapfix").iterdir()} == {f"two.{suffix}" for suffix in suffixes}
    report = json.loads(outputs["Ann.report.json"].read_text(encoding="utf-8"))
    assert (report["take"]["file"], report["take"]["person"], report["take"]["markers"]) == ("two.c3d", "Ann", 41)
    assert [each.report["fill"]["missing_before"] for each in result.subject_results] == [50, 50, 15]
    assert all(each.report["fill"]["left_empty"] == 0 for each in result.subject_results)
    assert "two.c3d (Ann)" in outputs["Ann.report.html"].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["Jim", "Ann"])
def test_each_subject_is_cleaned_as_in_a_file_of_its_own(files, two, name, tmp_path):
    _, outputs = two
    own_outputs = pipeline.clean(files / f"{name}.c3d").write(tmp_path)
    both, own = read_take(outputs["c3d"]), read_take(own_outputs["c3d"])
    markers = np.flatnonzero(np.array(both.marker_subjects) == name)
    np.testing.assert_allclose(both.markers[:, markers], own.markers, atol=1e-6)
    paths = (outputs[f"{name}.bvh"], own_outputs["bvh"])
    bvh, expected = (np.array(path.read_text(encoding="utf-8").split()[-FRAMES * 96 :], float) for path in paths)
    np.testing.assert_allclose(bvh, expected, atol=1e-3)  # centimetres and degrees


def test_one_file_contains_the_changes_of_all_subjects_and_no_others(files, two):
    result, outputs = two
    before, after = read_take(files / "two.c3d"), read_take(outputs["c3d"])
    assert after.visible.all()
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    old, new = (layout.view_words(path.read_bytes()) for path in (files / "two.c3d", outputs["c3d"]))
    np.testing.assert_array_equal((old != new).any(-1), ~before.visible)
    np.testing.assert_allclose(after.markers, result.take.markers, atol=1e-6)


def test_results_do_not_depend_on_the_number_of_cores(files, two, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    stages: list[str] = []
    with omit_stage_times():
        result = pipeline.clean(files / "two.c3d", progress=stages.append)
    for each, known in zip(result.subject_results, two[0].subject_results, strict=True):
        assert each.changes == known.changes
        assert {**each.report, "seconds": 0, "times": 0} == {**known.report, "seconds": 0, "times": 0}
        np.testing.assert_array_equal(each.take.markers, known.take.markers)
        if each.motion is not None and known.motion is not None:
            np.testing.assert_array_equal(each.motion.local_rotations, known.motion.local_rotations)
            np.testing.assert_array_equal(each.take.sample_sd, known.take.sample_sd)
    outputs = result.write(tmp_path)
    for suffix in ("c3d", "Jim.bvh", "Ann.bvh"):
        assert outputs[suffix].read_bytes() == two[1][suffix].read_bytes()
    assert stages[-1] == "3 of 3 subjects"


@pytest.mark.parametrize("cores", [1, 3])
@pytest.mark.parametrize("assigned", [(), (1,), (0, 1, 3)])
def test_what_one_subject_takes_is_not_available_to_the_next(assigned, cores, monkeypatch):
    """Each subject takes the first of the trajectories that are left if it is one of `assigned`."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    loose = Take(np.arange(60.0).reshape(4, 5, 3), tuple(f"*{n}" for n in range(5)), 120.0)
    takes = [replace(build_take((f"S{n}:LFHD",)), unlabelled=loose) for n in range(5)]

    def clean_one(take, *_):
        left = take.unlabelled
        if int(take.labels[0][1]) in assigned:
            left = replace(left, markers=left.markers[:, 1:], labels=left.labels[1:])
        return SimpleNamespace(take=replace(take, unlabelled=left), input_take=take)

    monkeypatch.setattr(pipeline, "identify_subject", lambda *_: None)
    monkeypatch.setattr(pipeline, "clean_subject", clean_one)
    results = pipeline.clean_subjects(takes, [NO_REVIEW] * 5, CleanOptions(), StageTimer())
    counts = [sum(each < n for each in assigned) for n in range(5)]
    given = [each.input_take.unlabelled for each in results]
    assert [each and each.labels for each in given] == [loose.labels[count:] for count in counts]


@pytest.fixture(scope="module")
def exchanged(files):
    """Return the take of two with the labels of Jim's and Ann's left foot exchanged in frames 81 to 120."""
    take = read_take(files / "two.c3d")
    points = take.markers.copy()
    for label in ("LANK", "LHEE", "LTOE", "LMT5"):
        jim, ann = (take.labels.index(f"{name}:{label}") for name in ("Jim", "Ann"))
        points[50:90, [jim, ann]] = points[50:90, [ann, jim]]
    path = files / "exchanged" / "two.c3d"
    path.parent.mkdir()
    path.write_bytes(build_c3d(points, take.labels, first=FIRST_FRAME))
    return path


@pytest.fixture(scope="module")
def corrected(exchanged, files):
    """Return the result of cleaning that take, and its output files."""
    result = pipeline.clean(exchanged)
    return result, result.write(files / "exchanged.mocapfix")


def test_labels_that_two_subjects_exchanged_are_exchanged_back(two, corrected):
    result, outputs = corrected
    np.testing.assert_allclose(result.take.markers, two[0].take.markers, atol=1e-5)
    np.testing.assert_allclose(read_take(outputs["c3d"]).markers, result.take.markers, atol=1e-6)
    swaps = [fault for fault in result.faults.items if fault.kind == "swap"]
    assert [(fault.first, fault.last) for fault in swaps] == [(50, 89)] * 4
    jim = result.subject_results[0]
    assert [change.samples for change in jim.changes if change.kind == "swap"] == [80] * 4
    note = "Jim and Ann had exchanged the labels LANK, LHEE, LTOE, LMT5 in frames 81 to 120; they are exchanged back."
    assert note in jim.subject_report["notes"]
    assert json.loads(outputs["Jim.report.json"].read_text(encoding="utf-8"))["changes"][0]["markers"] == ["Jim:LANK", "Ann:LANK"]
    assert "exchanged their labels" in outputs["Jim.report.html"].read_text(encoding="utf-8")


def test_exchanges_between_subjects_can_be_declined(exchanged, corrected, tmp_path):
    _, outputs = corrected
    declined = tmp_path / "declined.yaml"
    declined.write_text(
        outputs["Jim.changes.yaml"].read_text(encoding="utf-8").replace("decision: accept", "decision: reject"), encoding="utf-8"
    )
    result = pipeline.clean(exchanged, review_files=(declined,))
    assert not [fault for fault in result.faults.items if fault.kind == "swap" and fault.first == 50]
    changes = [change for change in result.subject_results[0].changes if change.kind == "swap" and "Ann:LANK" in change.markers]
    assert [change.decision for change in changes] == ["reject"]


def write_exchanges(source: Path, target: Path, names: tuple[str, str], frames: tuple[int, int]) -> Path:
    """Write a changes file with an exchange of all labels of two subjects."""
    entries = [
        {"kind": "swap", "markers": [f"{name}:{label}" for name in names], "first": frames[0], "last": frames[1]}
        for label in CMU41
    ]
    content = yaml.safe_load(source.read_text(encoding="utf-8"))
    target.write_text(yaml.safe_dump({**content, "corrections": entries}), encoding="utf-8")
    return target


@pytest.mark.parametrize("names", [("Jim", "Ann"), ("Ann", "Jim")])
def test_a_reviewer_exchanges_all_labels_of_two_subjects(files, two, names, tmp_path):
    """Where the labels of the whole take are exchanged no fault shows; the correction gives the cleaning of the right labels."""
    take = read_take(files / "two.c3d")
    columns = [[take.labels.index(f"{name}:{label}") for label in CMU41] for name in ("Jim", "Ann")]
    points = take.markers.copy()
    points[:, columns[0] + columns[1]] = points[:, columns[1] + columns[0]]
    (tmp_path / "two.c3d").write_bytes(build_c3d(points, take.labels, first=FIRST_FRAME))
    frames = (FIRST_FRAME, FIRST_FRAME + FRAMES - 1)
    path = write_exchanges(two[1][f"{names[0]}.changes.yaml"], tmp_path / "made.yaml", names, frames)
    result = pipeline.clean(tmp_path / "two.c3d", review_files=(path,))
    np.testing.assert_array_equal(result.take.markers, two[0].take.markers)
    for each, known in zip(result.subject_results, two[0].subject_results, strict=True):
        own = [change for change in each.changes if change.why == SWAP_REASON]
        is_file = each.input_take.subject_name == names[0]
        assert [change.markers for change in own] == [tuple(f"{name}:{label}" for name in names) for label in CMU41] * is_file
        assert [change for change in each.changes if change not in own] == list(known.changes)
        assert any("exchanged the labels" in note for note in each.subject_report["notes"]) == (
            each.input_take.subject_name != "others"
        )
    outputs = result.write(tmp_path / "out")
    written = {
        name: ChangesFileModel.model_validate(yaml.safe_load(outputs[f"{name}.changes.yaml"].read_text())) for name in names
    }
    assert [len(written[name].corrections) for name in names] == [len(CMU41), 0]
    reports = [json.loads(outputs[f"{name}.report.json"].read_text())["corrections"] for name in names]
    assert reports == [[each.model_dump(mode="json") for each in written[name].corrections] for name in names]
    again = pipeline.clean(tmp_path / "two.c3d", review_files=tuple(outputs[f"{name}.changes.yaml"] for name in names))
    np.testing.assert_array_equal(again.take.markers, result.take.markers)


def test_no_detection_undoes_what_a_reviewer_exchanged(files, two, tmp_path):
    path = write_exchanges(two[1]["Jim.changes.yaml"], tmp_path / "made.yaml", ("Jim", "Ann"), (61, 100))
    before, result = read_take(files / "two.c3d"), pipeline.clean(files / "two.c3d", review_files=(path,))
    jim, ann = ([before.labels.index(f"{name}:{label}") for label in CMU41] for name in ("Jim", "Ann"))
    frames, expected = slice(30, 70), before.markers.copy()
    expected[frames, jim + ann] = before.markers[frames, ann + jim]
    known = result.relabelled_take.visible[:, jim + ann]
    np.testing.assert_array_equal(result.relabelled_take.markers[:, jim + ann][known], expected[:, jim + ann][known])
    assert known.sum() == np.isfinite(expected[:, jim + ann, 0]).sum()
    kept = pipeline.clean(files / "two.c3d", review_files=(path,), frames=(31, 70))
    assert not [fault for fault in kept.faults.items if fault.reason == SWAP_REASON]  # frames that may not change


def test_an_exchange_with_a_subject_that_is_not_cleaned_is_refused(files, two, tmp_path):
    path = write_exchanges(two[1]["Jim.changes.yaml"], tmp_path / "made.yaml", ("Jim", "Ann"), (61, 100))
    with pytest.raises(SceneError, match=r"made\.yaml: corrections: Ann:.* is not cleaned with it"):
        pipeline.clean(files / "two.c3d", review_files=(path,), subject_prefix="Jim")
    write_exchanges(two[1]["Jim.changes.yaml"], path, ("Jim", "Tom"), (61, 100))
    with pytest.raises(SceneError, match=r"made\.yaml: corrections\.0\.markers: .* has no marker Tom:"):
        pipeline.clean(files / "two.c3d", review_files=(path,))


@pytest.mark.parametrize(
    "options", [{"repair_kinds": ("gap",)}, {"keep": ("LANK", "LHEE", "LTOE", "LMT5")}, {"frames": (31, 100)}]
)
def test_exchanges_between_subjects_are_left_where_nothing_may_change(exchanged, options):
    take = read_take(exchanged)
    parts = multi_subject.split_subjects(take)
    assert not correct_subject_labels(take, parts, (), CleanOptions().change(**options)).faults
    assert len(correct_subject_labels(take, parts, (), CleanOptions()).faults) == 4


def test_a_selected_subject_leaves_the_rest_of_the_file_unchanged(files, two, tmp_path):
    both, _ = two
    result = pipeline.clean(files / "two.c3d", subject_prefix="Jim", subject=both.subject_results[0].subject)
    outputs = result.write(tmp_path)
    assert {path.name for path in outputs.values()} >= {"two.c3d", "two.Jim.bvh", "two.Jim.report.json"}
    before, after = read_take(files / "two.c3d"), read_take(outputs["c3d"])
    is_jim = np.array(before.marker_subjects) == "Jim"
    assert after.visible[:, is_jim].all()
    np.testing.assert_array_equal(after.markers[:, ~is_jim], before.markers[:, ~is_jim])


def test_every_subject_has_a_review_file(files, two, tmp_path):
    result, outputs = two
    text = outputs["Ann.changes.yaml"].read_text(encoding="utf-8")
    assert text.count("decision: accept") == 2
    edited = tmp_path / "mine.yaml"
    edited.write_text(text.replace("decision: accept", "decision: reject", 1), encoding="utf-8")
    takes = [each.input_take for each in result.subject_results]
    of_jim, of_ann, of_others = read_changes_files([edited, outputs["Jim.changes.yaml"]], takes)
    assert tuple(len(each.declined) for each in (of_jim, of_ann, of_others)) == (0, 1, 0)
    assert takes[1].labels[of_ann.declined[0].markers[0]] in ("Ann:LFIN", "Ann:RSHN")
    with pytest.raises(SceneError, match=r"mine\.yaml is for two\.c3d \(Ann\) as well; give one of them"):
        read_changes_files([edited, outputs["Ann.changes.yaml"]], takes)
    with pytest.raises(
        SceneError, match=r"is for two\.c3d \(Ann\), not for two\.c3d \(Jim\); use the changes file of this take\."
    ):
        read_changes_files([edited], takes[:1])
    with pytest.raises(SceneError, match=r"\(Ann\), not for two\.c3d; .*, or select the subject with --subject-prefix\."):
        read_changes_files([edited], [result.input_take])


def test_a_subject_file_needs_the_name_of_one_of_several_subjects(files, two):
    with pytest.raises(
        TakeError, match="shows Jim and Ann, but --subject describes one person; name that person with --subject-"
    ):
        pipeline.clean(files / "two.c3d", subject=two[0].subject_results[0].subject)


def test_subject_files_of_other_people_are_refused(files, two, tmp_path):
    library.write_subject(tmp_path / "bob.yaml", two[0].subject_results[0].subject)
    with pytest.raises(TakeError, match=r"two\.c3d: shows Jim and Ann, but --subject is for Bob\."):
        pipeline.clean(files / "two.c3d", subject=(("Bob", tmp_path / "bob.yaml"),))


def test_a_memory_of_one_person_needs_the_name_of_one_of_several_subjects(files, tmp_path):
    with pytest.raises(TakeError, match="shows Jim and Ann, but --person-memory describes one person; name that person with"):
        pipeline.clean(files / "two.c3d", person_memory=tmp_path / "p.safetensors")
    with pytest.raises(TakeError, match=r"two\.c3d: shows Jim and Ann, but --person-memory is for Bob\."):
        pipeline.clean(files / "two.c3d", person_memory=(("Bob", tmp_path / "p.safetensors"),))


def test_each_subject_may_have_a_subject_file(files, two, tmp_path):
    library.write_subject(tmp_path / "ann.yaml", two[0].subject_results[1].subject)
    result = pipeline.clean(files / "two.c3d", subject=(("ann", tmp_path / "ann.yaml"),))
    jim, ann, *_ = result.subject_results
    known = library.read_subject(tmp_path / "ann.yaml")
    assert jim.subject
    assert ann.subject
    np.testing.assert_array_equal(ann.subject.skeleton.offsets, known.skeleton.offsets)
    np.testing.assert_array_equal(jim.subject.skeleton.offsets, two[0].subject_results[0].subject.skeleton.offsets)


def test_calibration_needs_the_name_of_one_of_several_subjects(files):
    with pytest.raises(TakeError, match="shows Jim and Ann; name the subject to calibrate with --subject-prefix"):
        pipeline.calibrate_takes([files / "two.c3d"])
    assert pipeline.calibrate_takes([files / "two.c3d"], subject_prefix="Ann").labels == CMU41


def test_existing_files_are_not_replaced_and_nothing_is_written(two, tmp_path):
    (tmp_path / "two.Ann.bvh").write_text("mine", encoding="utf-8")
    with pytest.raises(WriteError, match=r"two\.Ann\.bvh: already exists"):
        two[0].write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["two.Ann.bvh"]


def test_extra_formats_are_written_for_every_subject_except_the_common_c3d(two, tmp_path):
    options = OutputOptions(extra_formats=("npz", "c3d", "amc"), rigs=("blender",))
    outputs = two[0].write(tmp_path, options=options)
    of_subject = ("npz", "asf", "amc", "blender.bvh")
    expected = {"c3d", "others.npz", *(f"{name}.{suffix}" for name in ("Jim", "Ann") for suffix in of_subject)}
    assert {suffix for suffix in outputs if suffix.endswith(("c3d", *of_subject))} == expected
    with np.load(outputs["Ann.npz"]) as file:
        assert set(file["labels"]) == set(build_labels("Ann"))
        assert np.abs(file["root"][:, 0] - SUBJECT_OFFSET_M[0]).max() < 1.5


def test_subjects_with_the_same_file_names_are_an_error(two, tmp_path):
    jim = two[0].subject_results[0]
    second_jim = replace(jim, input_take=replace(jim.input_take, subject_name="JIM"))
    with pytest.raises(WriteError, match="would have the same name"):
        replace(two[0], subject_results=(jim, second_jim)).write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_samples_that_the_file_cannot_store_are_empty_in_the_report_of_their_subject(two, tmp_path):
    jim, ann, others = two[0].subject_results
    markers = ann.take.markers.copy()
    markers[5, 3] = 1e4  # metres; Cortex writes such values for missing markers
    sample_sd = np.where(markers[..., 0] == 1e4, 0.01, ann.take.sample_sd)
    far = replace(ann, take=ann.take.replace_markers(markers, sample_sd))
    take = two[0].input_take
    outputs = merge_results(SubjectExchanges(take, take), (jim, far, others)).write(tmp_path)
    fills = {
        name: json.loads(outputs[f"{name}.report.json"].read_text(encoding="utf-8"))["fill"] for name in ("Jim", "Ann", "others")
    }
    assert [fill["left_empty"] for fill in fills.values()] == [0, 1, 0]
    (run,) = fills["Ann"]["unfilled"]
    assert (run["marker"], run["first"], run["last"]) == (ann.input_take.labels[3], FIRST_FRAME + 5, FIRST_FRAME + 5)


def test_the_command_line_lists_every_subject(files, two, mocapfix, tmp_path):
    status, out, _ = mocapfix("inspect", files / "two.c3d", "--subject-prefix", "box")
    assert (status, " ".join(out.split()).startswith("two.c3d (box): 4 markers, frames 31 to 150 at 120 Hz.")) == (0, True)
    of_jim, of_ann = (tmp_path / f"{name}.yaml" for name in ("jim", "ann"))
    of_jim.write_text(two[1]["Jim.changes.yaml"].read_text(encoding="utf-8"), encoding="utf-8")
    of_ann.write_text(
        two[1]["Ann.changes.yaml"].read_text(encoding="utf-8").replace("decision: accept", "decision: reject", 1),
        encoding="utf-8",
    )
    arguments = ("--changes", of_jim, "--changes", of_ann, "--out", tmp_path / "out", "--json")
    status, out, _ = mocapfix("clean", files / "two.c3d", *arguments)
    left_empty = {report["take"]["person"]: report["fill"]["left_empty"] for report in json.loads(out)}
    assert (status, left_empty) == (0, {"Jim": 0, "Ann": 25, "others": 0})
    status, out, err = mocapfix("clean", files / "two.c3d", "--subject-prefix", "Bob", "--out", tmp_path / "none")
    assert (status, out) == (1, "")
    assert "its subjects are Jim, Ann, box" in " ".join(err.split())
    assert not (tmp_path / "none").exists()

"""Corrections by a reviewer: what a changes file may name, and what a cleaning makes of it."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import yaml

from mocapfix import pipeline
from mocapfix.errors import SceneError
from mocapfix.fill.gap_estimates import FillRequest
from mocapfix.fill.gap_filling import EMPTY_REASON, explain_requested_fills
from mocapfix.fill.gap_windows import FillMethod
from mocapfix.io.changes_file import (
    EXCLUDED_REASON,
    Review,
    build_fault_review,
    is_prevented,
    locate_correction,
    read_changes_file,
    write_changes_file,
)
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.model.changes import KEYS_METHOD
from mocapfix.model.faults import CorrectionKind, Fault, Fragment, RequestedFill
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.synthetic import compose_take, write_synthetic_take
from tests.io.test_changes_file import build_change, build_take

SEED, DURATION_S, RATE_HZ = 4, 3.0, 60.0


def build_correction(kind: CorrectionKind = "wrong", markers=("C7",), first=110, last=119, **fields) -> CorrectionModel:
    return CorrectionModel(kind=kind, markers=list(markers), first=first, last=last, **fields)


def build_review(*entries) -> Review:
    take = build_take()
    return Review(corrections=tuple(locate_correction(entry, take, "file") for entry in entries))


def test_corrections_notes_and_decisions_are_read_back_as_written(tmp_path):
    entries = [
        build_correction(note="it drifts: <b>really</b>"),
        build_correction("missing"),
        build_correction("swap", ("C7", "RBAC")),
        build_correction("assign", ("C7", "*12")),
        build_correction("fill", method="cluster"),
        build_correction("keys", points=[(110, 1.25, 900.0, -3.0), (119, 2.0, 901.5, -4.0)]),
    ]
    review = replace(build_review(*entries), reviewers={"spike-C7-110": "Ann"}, notes={"gap-RBAC-110": "a: note"})
    changes = [build_change(), build_change("gap", ("RBAC",), decision="accept")]
    path = tmp_path / "walk.changes.yaml"
    write_changes_file(path, build_take(), changes, review)
    again = read_changes_file(path, build_take())
    assert [each.entry for each in again.corrections] == entries
    assert [each.markers for each in again.corrections] == [(1,), (1,), (1, 2), (1, 3), (1,), (1,)]
    assert {(each.first, each.last) for each in again.corrections} == {(9, 18)}
    assert (again.reviewers, again.notes) == (review.reviewers, review.notes)
    write_changes_file(tmp_path / "again.yaml", build_take(), changes, again)
    assert (tmp_path / "again.yaml").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"kind": "wrong", "markers": ["NOSE"]}, "corrections.0.markers: walk.c3d has no marker NOSE."),
        ({"kind": "wrong", "markers": ["C7", "RBAC"]}, "corrections.0: wrong must name one marker."),
        ({"kind": "wrong", "markers": []}, "corrections.0: wrong must name one marker."),
        ({"kind": "swap", "markers": ["C7", "C7"]}, "corrections.0: swap must name two markers."),
        ({"kind": "swap", "markers": ["C7", "*12"]}, "corrections.0.markers: swap must name labelled markers"),
        ({"kind": "assign", "markers": ["C7", "RBAC"]}, "corrections.0.markers: RBAC is a labelled marker"),
        ({"kind": "assign", "markers": ["*12", "C7"]}, "corrections.0.markers: assign must name labelled markers"),
        ({"kind": "fill", "markers": ["C7"]}, "corrections.0: fill must have a method"),
        ({"kind": "keys", "markers": ["C7"]}, "corrections.0: keys must have two points or more"),
        ({"kind": "keys", "markers": ["C7"], "points": [[111, 1, 2, 3], [111, 1, 2, 3]]}, "corrections.0: keys must have two"),
        ({"kind": "keys", "markers": ["C7"], "points": [[109, 1, 2, 3], [111, 1, 2, 3]]}, "corrections.0: keys must have two"),
        ({"kind": "wrong", "markers": ["C7"], "points": [[111, 1, 2, 3]]}, "corrections.0: keys must have two points or more"),
        ({"kind": "wrong", "markers": ["C7"], "method": "body"}, "corrections.0: only fill has a method."),
        ({"kind": "fill", "markers": ["C7"], "method": "magic"}, "corrections.0.method: must be 'spline', "),
        ({"kind": "wrong", "markers": ["C7"], "last": 151}, "corrections.0: frames 110 to 151 are not in walk.c3d"),
        ({"kind": "wrong", "markers": ["C7"], "first": 120}, "corrections.0: frames 120 to 119 are not in walk.c3d"),
        ({"kind": "wrng", "markers": ["C7"]}, "corrections.0.kind: must be "),
        ({"kind": "wrong", "markers": ["C7"], "frame": 1}, "corrections.0.frame: there is no such key"),
    ],
)
def test_an_error_in_a_correction_names_the_file_and_the_key(tmp_path, entry, sentence):
    path = tmp_path / "walk.changes.yaml"
    write_changes_file(path, build_take(), [build_change()])
    data = yaml.safe_load(path.read_text(encoding="utf-8")) | {"corrections": [{"first": 110, "last": 119} | entry]}
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    with pytest.raises(SceneError) as error:
        read_changes_file(path, build_take())
    assert str(error.value).startswith(f"{path}: {sentence}")


def test_corrected_labels_are_not_corrected_again():
    is_accepted = build_fault_review(build_take(), build_review(build_correction("swap", ("C7", "RBAC")))).accepts
    assert not is_accepted(Fault("swap", 1, 12, 14, 0.1, "", other_markers=(2,)))
    assert not is_accepted(Fragment("fragment", 0, 5, 10, 0.1, "", donor=1))
    assert is_accepted(Fault("swap", 1, 19, 25, 0.1, "", other_markers=(2,)))
    assert is_accepted(Fault("spike", 1, 12, 14, 0.1, ""))


def test_a_request_that_cannot_be_met_is_the_reason():
    requests = [FillRequest(0, 22, 27, "spline"), FillRequest(1, 20, 29, "empty"), FillRequest(2, 20, 29, "body")]
    is_without_estimate = np.zeros((60, 3), bool)
    is_without_estimate[20:30, 1:] = True
    reasons = explain_requested_fills(np.full((60, 3), "", object), requests, is_without_estimate)
    assert set(reasons[20:30, 1]) == {EMPTY_REASON}
    assert all("body" in reason for reason in reasons[20:30, 2])
    assert not reasons[:, 0].any()


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A take with few faults: its path and its result."""
    path = tmp_path_factory.mktemp("sound") / "walk.c3d"
    truth = compose_take(seed=SEED, seconds=DURATION_S, rate=RATE_HZ)
    write_synthetic_take(path, replace(truth, missing_mask=np.zeros_like(truth.missing_mask)))
    result = pipeline.clean(path, prior="none")
    return path, result


def clean_with(sound, folder, *entries, **options):
    """Clean the take with corrections, given with frame indices; return the result."""
    path, first = sound[0], sound[1]
    number = first.input_take.first_frame
    numbered = [entry.model_copy(update={"first": entry.first + number, "last": entry.last + number}) for entry in entries]
    located = [locate_correction(entry, first.input_take, "file") for entry in numbered]
    target = folder / "walk.changes.yaml"
    write_changes_file(target, first.input_take, first.changes, Review(corrections=tuple(located)))
    return pipeline.clean(path, prior="none", subject=first.subject, review_files=(target,), **options)


def test_marked_samples_are_estimated_and_nothing_else_changes(sound, tmp_path):
    before = sound[1].take
    wrong, missing = before.labels[3], before.labels[20]
    result = clean_with(
        sound, tmp_path, build_correction("wrong", (wrong,), 60, 79), build_correction("missing", (missing,), 90, 99)
    )
    is_measured = (sound[1].input_take.markers == before.markers).all(-1)
    differs = (result.take.markers != before.markers).any(-1) & is_measured
    expected = np.zeros_like(differs)
    expected[60:80, 3] = expected[90:100, 20] = True
    np.testing.assert_array_equal(differs, expected)
    distance_m = np.linalg.norm(result.take.markers - before.markers, axis=-1)
    assert 0 < distance_m[differs].max() < 0.02
    marked = [change for change in result.changes if change.kind == "marked"]
    assert [(change.markers, change.samples) for change in marked] == [((wrong,), 20), ((missing,), 10)]
    assert [each.entry.kind for each in result.review.corrections] == ["wrong", "missing"]


def test_a_requested_fill_is_used_or_the_samples_stay_empty(sound, tmp_path):
    label = sound[1].take.labels[3]
    marked = build_correction("wrong", (label,), 60, 79)
    requests = [build_correction("fill", (label,), 60, 79, method=method) for method in get_args(RequestedFill)]
    result = clean_with(sound, tmp_path, marked)
    options = CleanOptions().change(prior="none", subject=sound[1].subject, review_files=(tmp_path / "walk.changes.yaml",))
    (planned,) = pipeline.plan_subject(sound[0], options, sound[1].take.name)
    take, fitted = planned.whole, planned.fit()
    first = take.first_frame
    alternatives = [
        [locate_correction(each.model_copy(update={"first": 60 + first, "last": 79 + first}), take, "file")] for each in requests
    ]
    shown = [filled.take.markers[60:80, 3] for filled in fitted.fill_gaps(alternatives, options)]
    methods: dict[str, np.ndarray] = {}
    for request, positions in zip(requests, shown, strict=True):
        method = str(request.method)
        result = clean_with(sound, tmp_path, marked, request)
        methods[method] = result.take.markers[60:80, 3]
        np.testing.assert_array_equal(methods[method], positions)  # as they were estimated without cleaning again
        assert {change.method for change in result.changes if change.kind == "marked"} == {
            "removed" if np.isnan(positions).all() else f"estimated, mostly from {FillMethod[method.upper()].description}"
        }
        if method == "empty":
            assert EMPTY_REASON in {run.reason for run in result.unfilled_runs}
    assert np.isnan(methods.pop("empty")).all()
    assert np.isnan(methods.pop("rigid_group")).all()  # the marker is in no rigid group
    assert all(np.isfinite(positions).all() for positions in methods.values())
    assert len({positions.tobytes() for positions in methods.values()}) == len(methods)


def test_points_set_by_hand_replace_samples_and_are_named(sound, tmp_path):
    before = sound[1].take
    path, first, label = before.markers[:, 3], before.first_frame, before.labels[3]
    moved = path[[65, 72]] + [0.0, 0.03, 0.0]
    points = [(frame + first, *np.round(at * 1e3, 2).tolist()) for frame, at in zip((65, 72), moved, strict=True)]
    result = clean_with(sound, tmp_path, build_correction("keys", (label,), 60, 79, points=points))
    after = result.take.markers[:, 3]
    np.testing.assert_allclose(after[[65, 72]], moved, atol=1e-5)
    is_kept = sound[1].input_take.visible[:, 3].copy()
    is_kept[60:80] = False
    np.testing.assert_array_equal(after[is_kept], path[is_kept])
    steps = np.linalg.norm(np.diff(after[58:82], axis=0), axis=1)
    assert steps.max() < 3 * np.linalg.norm(np.diff(path[58:82], axis=0), axis=1).max()  # it goes on from the samples beside it
    [change] = [change for change in result.changes if change.markers == (label,) and change.kind == "marked"]
    assert (change.why, change.method) == ("A reviewer set the samples by hand.", f"estimated, mostly from {KEYS_METHOD}")
    [usual] = [
        each for each in clean_with(sound, tmp_path, build_correction("wrong", (label,), 60, 79)).changes if each.kind == "marked"
    ]
    assert change.predicted_mm == pytest.approx(usual.predicted_mm, rel=0.1)  # that of the estimate in its place
    target = tmp_path / "written.yaml"
    write_changes_file(target, result.input_take, result.changes, result.review)
    assert read_changes_file(target, result.input_take).corrections == result.review.corrections


def test_exchanged_labels_stay_exchanged(sound, tmp_path):
    before = sound[1].take
    one, other = before.labels.index("LKNE"), before.labels.index("RKNE")
    result = clean_with(sound, tmp_path, build_correction("swap", ("LKNE", "RKNE"), 60, 99))
    assert (result.take.source_points[60:100, one] == before.point_indices[other]).mean() > 0.9
    swaps = [change for change in result.changes if change.kind in ("swap", "mislabelled")]
    assert [(change.markers, change.samples) for change in swaps] == [(("LKNE", "RKNE"), 80)]


def test_what_a_reviewer_requests_is_done_whatever_kinds_are_repaired(sound, tmp_path):
    label = sound[1].take.labels[3]
    clean_with(sound, tmp_path, build_correction("wrong", (label,), 60, 79), build_correction("swap", ("LKNE", "RKNE"), 60, 99))
    result = pipeline.clean(
        sound[0], prior="none", subject=sound[1].subject, review_files=(tmp_path / "walk.changes.yaml",), repair_kinds=("spike",)
    )
    assert {"marked", "swap"} <= {change.kind for change in result.changes}


@pytest.mark.parametrize("kind", ["swap", "wrong", "missing"])
def test_a_correction_that_options_prevent_changes_no_sample_and_has_a_note(sound, tmp_path, kind):
    kept, other = sound[1].take.labels[3], sound[1].take.labels[20]
    markers = (other, kept) if kind == "swap" else (kept,)
    entry = build_correction(kind, markers, 60, 79)
    result = clean_with(sound, tmp_path, entry, build_correction("wrong", (other,), 90, 99), keep=(kept,))
    before = result.input_take.markers
    np.testing.assert_array_equal(result.take.markers[60:80, [3, 20]], before[60:80, [3, 20]])
    first = result.input_take.first_frame
    sentence = (
        f"A correction is not made ({kind} {' and '.join(markers)}, frames {60 + first} to {79 + first}): {EXCLUDED_REASON}."
    )
    assert [note for note in result.subject_report["notes"] if "is not made" in note] == [sentence]
    assert [(each["kind"], each["markers"]) for each in result.subject_report.get("corrections", ())] == [("wrong", [other])]


def test_frames_prevent_a_change_of_labels_in_part_and_others_in_whole():
    options = FillOptions(frames=(112, 130))
    assert is_prevented(build_correction("swap", ("C7", "RBAC")), options)  # of frames 110 to 119
    assert not is_prevented(build_correction(), options)
    assert not is_prevented(build_correction("assign", ("C7", "*12"), 112, 130), options)
    assert is_prevented(build_correction(first=100, last=111), options)
    assert is_prevented(build_correction("swap", ("Jim:C7", "Jim:RBAC")), FillOptions(keep=("RBAC",)))

"""Decisions on a take with one fault of each kind: what is rejected is not changed, and nothing else differs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import pipeline
from mocapfix.contacts.body_contacts import hold_standing_feet
from mocapfix.fill.gap_filling import fill_gaps
from mocapfix.io import capture, changes_file
from mocapfix.io.changes_file import Review
from mocapfix.io.patches import patch_c3d
from mocapfix.io.yaml_files import ChangeModel
from mocapfix.model.changes import Filled, compare_samples, serialize_changes
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault, FaultReview, Faults, Fragment, MarkerShift
from mocapfix.model.stage_timer import StageTimer
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, DetectOptions, FillOptions, SubjectOptions
from mocapfix.review.apply_decisions import apply_decisions
from mocapfix.solve.motion_solver import complete_body
from mocapfix.stats.sequences import find_runs
from tests.faulty_take import (
    FAULTS,
    FIRST_FRAME,
    GAP,
    INSIDE_SWAP,
    LABELLED_FRAGMENT,
    SPIKE,
    SWAP,
    UNLABELLED_FRAGMENT,
    find_changed_runs,
)

NAN = np.nan


def list_changed_runs(ids):
    """List the runs of samples that differ if these changes are made. A spike inside a swap is repaired with it or not at all."""
    found = {(label, *FAULTS[each][1:]) for each in ids for label in FAULTS[each][0]}
    return found - {("LWRB", 250, 250)}


def write_review(faulty, folder, **by_decision) -> Path:
    """Write the review file of the take with these decisions on these changes."""
    decision_by_id = {each: decision for decision, ids in by_decision.items() for each in ids}
    changes = [replace(change, decision=decision_by_id.get(change.id, "accept")) for change in faulty.result.changes]
    path = folder / "decided.changes.yaml"
    changes_file.write_changes_file(path, faulty.result.input_take, changes)
    return path


def clean_again(faulty, folder, **options):
    """Clean the take with other options; return the result and the C3D file."""
    result, output = pipeline.clean(faulty.path, subject=faulty.subject, **options), folder / "again.c3d"
    assert patch_c3d(output, result.input_take, result.take) == []
    return result, output


@pytest.fixture(scope="module")
def proposed(faulty) -> tuple[Take, Filled]:
    """The faulty take before decisions are applied: as read, and filled."""
    options, take = CleanOptions(), capture.read_take(faulty.path)
    choice = pipeline.identify_subject(take, SubjectOptions(subject=faulty.subject))
    _, detected, body = pipeline.detect_and_fit(take, choice, FaultReview(), options, StageTimer())
    assert body is not None
    standing = hold_standing_feet(complete_body(body, None, options), take, "soft")
    body = replace(standing.fit, motion=standing.filling_motion)
    return take, next(fill_gaps(detected, body, {}, [()], options.fill))


def test_every_fault_is_repaired(faulty):
    assert {c.id: (c.markers, c.first - FIRST_FRAME, c.last - FIRST_FRAME) for c in faulty.result.changes} == FAULTS
    assert find_changed_runs(faulty.path, faulty.output) == list_changed_runs(FAULTS)
    off = np.linalg.norm(faulty.result.take.markers[:, :-1] - faulty.truth, axis=-1)
    assert off.max() < 0.02
    assert (off < 1e-6).mean() > 0.998


@pytest.mark.parametrize(
    "rejected",
    [(GAP, SWAP, UNLABELLED_FRAGMENT), (SPIKE, LABELLED_FRAGMENT, INSIDE_SWAP), tuple(FAULTS)],
    ids=["these", "those", "all"],
)
def test_rejected_changes_are_not_made_and_nothing_else_differs(faulty, tmp_path, rejected):
    result, output = clean_again(faulty, tmp_path, review_files=write_review(faulty, tmp_path, reject=rejected))
    accepted = set(FAULTS) - set(rejected)
    assert find_changed_runs(faulty.path, output) == list_changed_runs(accepted)
    inside = {("LWRB", 250, 250)} if INSIDE_SWAP in rejected and SWAP in accepted else set()
    assert find_changed_runs(faulty.output, output) == list_changed_runs(rejected) | inside
    by_id = {change.id: change for change in result.changes}
    assert {each for each, change in by_id.items() if change.decision == "reject"} == set(rejected)
    assert all((by_id[each].samples, by_id[each].after) == (0, by_id[each].before) for each in rejected)
    if not accepted:
        assert output.read_bytes() == faulty.path.read_bytes()


@given(rejected=st.sets(st.sampled_from(sorted(FAULTS))), only=st.sets(st.sampled_from(["gap", "spike", "swap", "fragment"])))
def test_any_may_be_rejected_and_some_kinds_selected(faulty, proposed, tmp_path_factory, rejected, only):
    folder = tmp_path_factory.mktemp("some")
    before = faulty.result.input_take
    reviewed = changes_file.read_changes_file(write_review(faulty, folder, reject=rejected), before)
    options = CleanOptions(detect=DetectOptions(repair_kinds=tuple(only)))
    decided = apply_decisions(proposed[0], proposed[1], reviewed, options, is_smoothed=False)
    patch_c3d(folder / "some.c3d", before, decided.take)
    made = {each for each in set(FAULTS) - rejected if not only or each.split("-")[0] in only}
    alone = {("LWRB", 250, 250)} if SWAP in made else set()
    differs_from_all = list_changed_runs(set(FAULTS) - made) | (alone if INSIDE_SWAP not in made else set())
    assert find_changed_runs(faulty.path, folder / "some.c3d") == list_changed_runs(made)
    assert find_changed_runs(faulty.output, folder / "some.c3d") == differs_from_all
    without_effect = {INSIDE_SWAP} if SWAP not in made else set()
    assert {change.id for change in decided.changes if change.samples} == made - without_effect
    assert {change.id for change in decided.changes if change.decision == "reject"} == rejected


def test_kept_samples_are_used_in_the_solve(faulty, tmp_path):
    result, output = clean_again(faulty, tmp_path, review_files=write_review(faulty, tmp_path, keep=[SPIKE, SWAP]))
    assert find_changed_runs(faulty.path, output) == list_changed_runs({GAP, LABELLED_FRAGMENT, UNLABELLED_FRAGMENT})
    assert {fault.kind for fault in result.faults.items} == {"gap", "fragment"}
    labels, error = result.input_take.labels, result.residual_m
    assert error is not None
    assert error[20, labels.index("STRN")] > 0.1  # kept samples have residuals, faulty ones have none
    assert error[222:288, labels.index("LWRA")].min() > 0.02
    assert {c.id: c.decision for c in result.changes if c.decision != "accept"} == {SPIKE: "keep", SWAP: "keep"}


@pytest.mark.parametrize(
    ("options", "made"),
    [
        ({"repair_kinds": ("gap",)}, {GAP}),
        ({"repair_kinds": ("spike", "fragment")}, {SPIKE, LABELLED_FRAGMENT, UNLABELLED_FRAGMENT}),
        ({"keep": ("LWRB", "RFHD")}, {SPIKE, GAP, UNLABELLED_FRAGMENT}),
        ({"frames": (FIRST_FRAME + 30, FIRST_FRAME + 260)}, {GAP, LABELLED_FRAGMENT, UNLABELLED_FRAGMENT}),
    ],
    ids=["gaps", "two kinds", "one of a swapped pair", "frames that cut a swap"],
)
def test_only_requested_samples_are_changed(faulty, tmp_path, options, made):
    result, output = clean_again(faulty, tmp_path, **options)
    assert find_changed_runs(faulty.path, output) == list_changed_runs(made)
    assert {change.id for change in result.changes} == made


# on four markers made by hand


def four(**given) -> Take:
    markers = np.arange(4 * 20 * 3, dtype=float).reshape(20, 4, 3)
    return Take(markers, ("A", "B", "C", "D"), 100.0, **given)


def decide(before, detection, repaired, kinds=(), keep=(), reviewed=()):
    """Apply decisions to a repaired take; return the cleaned take and the changes."""
    methods = np.where(compare_samples(detection.take, repaired), "guessing", "")
    filled = Filled(detection, repaired, np.full(before.visible.shape, "", object), methods, None)
    options = CleanOptions(detect=DetectOptions(repair_kinds=tuple(kinds)), fill=FillOptions(keep=tuple(keep)))
    decided = apply_decisions(before, filled, Review(tuple(reviewed)), options, is_smoothed=False)
    return decided.take, decided.changes


def different(one: Take, other: Take):
    """Return the runs of samples that differ, by label."""
    where = compare_samples(one, other)
    return {label: find_runs(where[:, m]) for m, label in enumerate(one.labels) if where[:, m].any()}


def filled(take: Take, *intervals) -> Take:
    """Fill intervals (marker, first, last) of a take."""
    markers = take.markers.copy()
    for m, first, last in intervals:
        markers[first : last + 1, m] = -1.0
    return take.replace_markers(markers)


@pytest.mark.parametrize(
    "remark",
    [
        Fault("noise", 0, 0, 19, 0.01, "It is noisy throughout."),
        Fault("segment lost", 0, 5, 9, NAN, "Nothing is visible.", 1.0, (1,)),
        Fault("mislabelled", 0, 0, 19, 0.1, "It may be mislabelled.", 0.3, (1,)),
        Fragment("fragment", 0, 0, 19, 0.1, "It doubles A.", donor=1, relation="doubles"),
    ],
    ids=lambda fault: fault.kind,
)
@pytest.mark.parametrize("only", [(), ("gap",)])
def test_reported_faults_are_no_changes(remark, only):
    before = four()
    before.markers[5:10, :2] = NAN
    gaps = (Fault("gap", 0, 5, 9, 0.1, "Hidden."), Fault("gap", 1, 5, 9, 0.1, "Hidden."))
    repaired = filled(before, (0, 5, 9), (1, 5, 9))
    after, changes = decide(before, Detected(before, (), Faults((remark, *gaps))), repaired, only)
    assert [change.kind for change in changes] == ["gap", "gap"]
    assert different(before, after) == {"A": [(5, 9)], "B": [(5, 9)]}


def test_gap_within_a_rejected_burst_is_filled():
    before = four()
    before.markers[8:10, 0] = NAN
    burst, gap = Fault("jitter", 0, 5, 14, 0.01, "It has jitter."), Fault("gap", 0, 8, 9, 0.01, "Hidden.")
    repaired, detection = filled(before, (0, 5, 14)), Detected(before, (), Faults((burst, gap)))
    after, changes = decide(before, detection, repaired)
    assert {change.kind: change.samples for change in changes} == {"jitter": 8, "gap": 2}
    change = next(change for change in changes if change.kind == "jitter")
    entry = ChangeModel.model_validate(serialize_changes([change])[0] | {"decision": "reject"})
    rejected = changes_file.ReviewedChange(entry, (0,), 5, 14)
    after, changes = decide(before, detection, repaired, reviewed=(rejected,))
    assert different(before, after) == {"A": [(8, 9)]}
    assert {change.kind: change.samples for change in changes} == {"jitter": 0, "gap": 2}


def test_one_of_two_overlapping_swaps_may_be_refused():
    before = four()
    first, second = Fault("swap", 0, 0, 9, 0.1, "One.", 1.0, (1,)), Fault("swap", 1, 5, 14, 0.1, "Other.", 1.0, (2,))
    righted = before.exchange_labels((0, 1), 0, 9).exchange_labels((1, 2), 5, 14)
    detection = Detected(righted, (first, second), Faults())
    for kept, swap in ((0, second), (2, first)):
        after, changes = decide(before, detection, righted, keep=(before.labels[kept],))
        np.testing.assert_array_equal(after.markers, before.exchange_labels(swap.markers, swap.first, swap.last).markers)
        assert [(change.kind, change.samples) for change in changes] == [("swap", 20)]


def test_marker_shift_is_a_change_without_samples():
    before = four()
    before.markers[12:14, 0] = NAN
    knocked, gap = MarkerShift("moved", 0, 10, 19, 0.04, "Knocked.", settled_frame=10), Fault("gap", 0, 12, 13, 0.01, "Hidden.")
    _, changes = decide(before, Detected(before, (), Faults((knocked, gap))), filled(before, (0, 12, 13)), kinds=("gap",))
    assert {change.kind: change.samples for change in changes} == {"moved": 0, "gap": 2}


def test_external_fill_stays_if_the_estimate_agrees():
    before = four()
    straight = Fault("straight", 0, 5, 9, 0.01, "Filled.")
    detection = Detected(before, (), Faults((straight,)))
    for off, differing_runs in ((0.001, {}), (0.1, {"A": [(5, 9)]})):
        repaired = replace(filled(before), sample_sd=np.full(before.visible.shape, NAN))
        repaired.markers[5:10, 0] += off
        assert repaired.sample_sd is not None
        repaired.sample_sd[5:10, 0] = 0.001
        after, _ = decide(before, detection, repaired)
        assert different(before, after) == differing_runs

"""Decisions on a take in which one of each is wrong: what is rejected is not made, and nothing else differs."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import pipeline, write
from mocapfix.changes import compare_samples
from mocapfix.detect.loop import DetectionState
from mocapfix.faults import Fault, Faults, Fragment, MarkerShift
from mocapfix.options import DEFAULT_INIT_METHOD
from mocapfix.options import FillOptions
from mocapfix.read import capture
from mocapfix.repair import apply_decisions
from mocapfix.report import review_file
from mocapfix.report.stage_timer import StageTimer
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take
from tests.muddled import FIRST, FRAGMENT, GAP, INSIDE, LOOSE, SPIKE, SWAP, WRONG, differing

NAN = np.nan


def touched(ids):
    """-> the runs of samples that differ where these changes are made; a spike inside a swap is mended with it or not at all"""
    found = {(label, *WRONG[each][1:]) for each in ids for label in WRONG[each][0]}
    return found - {("LWRB", 250, 250)}


def decided(muddled, folder, **by_decision) -> Path:
    """-> the take's changes file with these ids decided so."""
    decision = {each: said for said, ids in by_decision.items() for each in ids}
    changes = [replace(change, decision=decision.get(change.id, "accept")) for change in muddled.result.changes]
    path = folder / "decided.changes.yaml"
    review_file.write_review_file(path, muddled.result.before, changes)
    return path


def again(muddled, folder, **asked):
    """-> the take cleaned with other wishes, and as a C3D."""
    result, output = pipeline.clean(muddled.path, subject=muddled.subject, **asked), folder / "again.c3d"
    assert write.patch_c3d(output, result.input_take, result.take) == []
    return result, output


@pytest.fixture(scope="module")
def muddled_taken(muddled):
    """-> decisions.taken of the muddled take, to be called with touch, only and decided"""
    take = capture.read_capture(muddled.path)
    known, worn_set, _ = pipeline.select_subject(take, None, muddled.subject)
    how = pipeline.build_settings(build_clean_options(prior="none"))
    looked, parts, body = pipeline.detect_and_fit(take, worn_set, known, how, lambda fault: True, StageTimer())
    assert body
    whole, _, ways = pipeline.fill_gaps(looked, parts, body, FillOptions())
    return partial(apply_decisions.apply_decisions, take, looked, whole, body.expand_to_take(parts), ways)


def test_one_of_each_is_wrong_and_all_of_it_is_put_right(muddled):
    assert {c.id: (c.markers, c.first - FIRST, c.last - FIRST) for c in muddled.result.changes} == WRONG
    assert differing(muddled.path, muddled.output) == touched(WRONG)
    off = np.linalg.norm(muddled.result.take.markers[:, :-1] - muddled.truth, axis=-1)
    assert off.max() < 0.02
    assert (off < 1e-6).mean() > 0.998


@pytest.mark.parametrize("rejected", [(GAP, SWAP, LOOSE), (SPIKE, FRAGMENT, INSIDE), tuple(WRONG)], ids=["these", "those", "all"])
def test_what_is_rejected_is_not_made_and_nothing_else_differs(muddled, tmp_path, rejected):
    result, output = again(muddled, tmp_path, review_files=decided(muddled, tmp_path, reject=rejected))
    accepted = set(WRONG) - set(rejected)
    assert differing(muddled.path, output) == touched(accepted)
    inside = {("LWRB", 250, 250)} if INSIDE in rejected and SWAP in accepted else set()
    assert differing(muddled.output, output) == touched(rejected) | inside
    said = {change.id: change for change in result.changes}
    assert {each for each, change in said.items() if change.decision == "reject"} == set(rejected)
    assert all((said[each].samples, said[each].after) == (0, said[each].before) for each in rejected)
    if not accepted:
        assert output.read_bytes() == muddled.path.read_bytes()


@given(rejected=st.sets(st.sampled_from(sorted(WRONG))), only=st.sets(st.sampled_from(["gap", "spike", "swap", "fragment"])))
def test_any_of_them_may_be_rejected_and_only_some_kinds_asked_for(muddled, muddled_taken, tmp_path_factory, rejected, only):
    folder = tmp_path_factory.mktemp("some")
    before = muddled.result.before
    decided_upon = review_file.read_review_file(decided(muddled, folder, reject=rejected), before)
    after, told = muddled_taken(np.ones(before.visible.shape, bool), tuple(only), decided_upon)
    write.patch_c3d(folder / "some.c3d", before, after)
    made = {each for each in set(WRONG) - rejected if not only or each.split("-")[0] in only}
    alone = {("LWRB", 250, 250)} if SWAP in made else set()
    differs_from_all = touched(set(WRONG) - made) | (alone if INSIDE not in made else set())
    assert differing(muddled.path, folder / "some.c3d") == touched(made)
    assert differing(muddled.output, folder / "some.c3d") == differs_from_all
    without_effect = {INSIDE} if SWAP not in made else set()
    assert {change.id for change in told if change.samples} == made - without_effect
    assert {change.id for change in told if change.decision == "reject"} == rejected


def test_what_is_kept_is_believed(muddled, tmp_path):
    result, output = again(muddled, tmp_path, review_files=decided(muddled, tmp_path, keep=[SPIKE, SWAP]))
    assert differing(muddled.path, output) == touched({GAP, FRAGMENT, LOOSE})
    assert {fault.kind for fault in result.faults.items} == {"gap", "fragment"}
    labels, error = result.input_take.labels, result.residual_m
    assert error is not None
    assert error[20, labels.index("STRN")] > 0.1  # the body was held against it, where a faulty sample is not
    assert error[222:288, labels.index("LWRA")].min() > 0.02
    assert {c.id: c.decision for c in result.changes if c.decision != "accept"} == {SPIKE: "keep", SWAP: "keep"}


@pytest.mark.parametrize(
    ("asked", "made"),
    [
        ({"repair_kinds": ("gap",)}, {GAP}),
        ({"repair_kinds": ("spike", "fragment")}, {SPIKE, FRAGMENT, LOOSE}),
        ({"keep": ("LWRB", "RFHD")}, {SPIKE, GAP, LOOSE}),
        ({"frames": (FIRST + 30, FIRST + 260)}, {GAP, FRAGMENT, LOOSE}),
    ],
    ids=["gaps", "two kinds", "one of a swapped pair", "frames that cut a swap"],
)
def test_only_what_is_asked_for_is_touched(muddled, tmp_path, asked, made):
    result, output = again(muddled, tmp_path, **asked)
    assert differing(muddled.path, output) == touched(made)
    assert {change.id for change in result.changes} == made


# by hand, on four markers


def four(**given) -> Take:
    markers = np.arange(4 * 20 * 3, dtype=float).reshape(20, 4, 3)
    return Take(markers, ("A", "B", "C", "D"), 100.0, **given)


def all_made(before, looked, whole, only=(), touch=None, decided=()):
    ways = np.where(compare_samples(looked.take, whole), "guessing", "")
    touch = np.ones(before.visible.shape, bool) if touch is None else touch
    return apply_decisions.apply_decisions(before, looked, whole, None, ways, touch, only, decided)


def different(one: Take, other: Take):
    """-> {label: runs}"""
    where = compare_samples(one, other)
    return {label: find_runs(where[:, m]) for m, label in enumerate(one.labels) if where[:, m].any()}


def filled(take: Take, *intervals) -> Take:
    """-> the take with other samples over (marker, first, last)"""
    markers = take.markers.copy()
    for m, first, last in intervals:
        markers[first : last + 1, m] = -1.0
    return take.replace_markers(markers)


@pytest.mark.parametrize(
    "remark",
    [
        Fault("noise", 0, 0, 19, 0.01, "It trembles all along."),
        Fault("segment lost", 0, 5, 9, NAN, "Nothing is seen.", 1.0, (1,)),
        Fault("mislabelled", 0, 0, 19, 0.1, "It may be the other's.", 0.3, (1,)),
        Fragment("fragment", 0, 0, 19, 0.1, "It doubles A.", donor=1, relation="doubles"),
    ],
    ids=lambda fault: fault.kind,
)
@pytest.mark.parametrize("only", [(), ("gap",)])
def test_what_nothing_comes_of_is_no_change_and_takes_none_back(remark, only):
    before = four()
    before.markers[5:10, :2] = NAN
    gaps = (Fault("gap", 0, 5, 9, 0.1, "Hidden."), Fault("gap", 1, 5, 9, 0.1, "Hidden."))
    whole = filled(before, (0, 5, 9), (1, 5, 9))
    after, told = all_made(before, DetectionState(before, (), Faults((remark, *gaps))), whole, only)
    assert [change.kind for change in told] == ["gap", "gap"]
    assert different(before, after) == {"A": [(5, 9)], "B": [(5, 9)]}


def test_a_gap_within_a_rejected_burst_is_filled_all_the_same():
    before = four()
    before.markers[8:10, 0] = NAN
    burst, gap = Fault("jitter", 0, 5, 14, 0.01, "It trembles."), Fault("gap", 0, 8, 9, 0.01, "Hidden.")
    whole, looked = filled(before, (0, 5, 14)), DetectionState(before, (), Faults((burst, gap)))
    after, told = all_made(before, looked, whole)
    assert {change.kind: change.samples for change in told} == {"jitter": 8, "gap": 2}
    change = next(change for change in told if change.kind == "jitter")
    rejected = review_file.ReviewedChange(review_file.serialize_changes([change])[0], (0,), 5, 14, "reject")
    after, told = all_made(before, looked, whole, decided=(rejected,))
    assert different(before, after) == {"A": [(8, 9)]}
    assert {change.kind: change.samples for change in told} == {"jitter": 0, "gap": 2}


def test_of_two_swaps_that_meet_one_may_be_refused_and_no_sample_is_doubled():
    before = four()
    first, second = Fault("swap", 0, 0, 9, 0.1, "One.", 1.0, (1,)), Fault("swap", 1, 5, 14, 0.1, "Other.", 1.0, (2,))
    righted = before.exchange_labels((0, 1), 0, 9).exchange_labels((1, 2), 5, 14)
    looked = DetectionState(righted, (first, second), Faults())
    for kept, swap in ((0, second), (2, first)):
        touch = np.ones(before.visible.shape, bool)
        touch[:, kept] = False
        after, told = all_made(before, looked, righted, touch=touch)
        np.testing.assert_array_equal(after.markers, before.exchange_labels(swap.markers, swap.first, swap.last).markers)
        assert [(change.kind, change.samples) for change in told] == [("swap", 20)]


def test_a_moved_marker_is_an_entry_without_samples():
    before = four()
    before.markers[12:14, 0] = NAN
    knocked, gap = MarkerShift("moved", 0, 10, 19, 0.04, "Knocked.", settled_frame=10), Fault("gap", 0, 12, 13, 0.01, "Hidden.")
    _, told = all_made(before, DetectionState(before, (), Faults((knocked, gap))), filled(before, (0, 12, 13)), only=("gap",))
    assert {change.kind: change.samples for change in told} == {"moved": 0, "gap": 2}


def test_another_programs_fill_stays_where_ours_agrees_with_it():
    before = four()
    straight = Fault("straight", 0, 5, 9, 0.01, "Laid.")
    looked = DetectionState(before, (), Faults((straight,)))
    for off, differing_runs in ((0.001, {}), (0.1, {"A": [(5, 9)]})):
        whole = replace(filled(before), deviation=np.full(before.visible.shape, NAN))
        whole.markers[5:10, 0] += off
        assert whole.sample_sd is not None
        whole.sample_sd[5:10, 0] = 0.001
        after, _ = all_made(before, looked, whole)
        assert different(before, after) == differing_runs

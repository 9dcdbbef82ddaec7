"""Entries of changes, the samples that faults concern, and the runs of samples that stay unfilled."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.model.changes import (
    SampleState,
    UnfilledRun,
    build_affected_mask,
    build_changes,
    compare_samples,
    find_unfilled_runs,
    list_affected_markers,
)
from mocapfix.model.faults import REPLACED_SAMPLE_KINDS, Fault, Fragment, MarkerShift
from mocapfix.model.take import Take

NAN = np.nan
FRAMES = 20


def build_take() -> Take:
    """Return a take of A (missing in 5-8), B and A-1 (visible in 5-8 only), numbered from 101, and the unlabelled *4."""
    markers = np.zeros((FRAMES, 3, 3))
    markers[5:9, 0] = markers[:5, 2] = markers[9:, 2] = NAN
    unlabelled = Take(np.ones((FRAMES, 1, 3)), ("*4",), 100.0, point_columns=np.array([3]))
    return Take(markers, ("A", "Jim:B", "A-1"), 100.0, 101, point_columns=np.arange(3), unlabelled=unlabelled)


def list_changes(before, after, *faults, relabelled=None, body=None):
    methods = np.where(compare_samples(before, after) & after.visible, "the body", "")
    return [change for change, _ in build_changes(before, relabelled or before, after, faults, body, methods)]


GAP = Fault("gap", 0, 5, 8, 0.1, "A is missing.")
SWAP = Fault("swap", 0, 12, 15, 0.1, "Exchanged.", 1.0, (1,))


def test_change_has_file_frame_numbers_and_states():
    before, after = build_take(), build_take()
    after.markers[5:9, 0] = [0.003, 0.0, 0.0]
    sample_sd = np.full((FRAMES, 3), NAN)
    sample_sd[5:9, 0] = 0.002
    body = np.zeros((FRAMES, 3, 3))
    (change,) = list_changes(before, replace(after, sample_sd=sample_sd), GAP, body=body)
    assert (change.id, change.kind, change.markers, change.first, change.last) == ("gap-A-106", "gap", ("A",), 106, 109)
    assert (change.samples, change.why, change.decision) == (4, "A is missing.", "accept")
    assert (change.before, change.after) == (SampleState(4, None), SampleState(0, 3.0))
    assert change.predicted_mm == pytest.approx(np.sqrt(3) * 2.0, abs=0.05)  # a distance: three axes
    assert change.method == "estimated, mostly from the body"


def test_fault_without_effect_is_no_change_unless_it_is_a_shift():
    shift = MarkerShift("moved", 1, 10, 19, 0.04, "Moved.", settled_frame=10)
    assert [change.kind for change in list_changes(build_take(), build_take(), GAP, SWAP, shift)] == ["moved"]


def test_method_of_removed_samples():
    after = build_take()
    after.markers[3, 1] = NAN
    (change,) = list_changes(build_take(), after, Fault("ghost", 1, 3, 3, 0.1, ""))
    assert (change.method, change.before.missing, change.after.missing) == ("removed", 0, 1)


def test_change_ids_are_unique_and_without_blanks():
    before, after = build_take(), build_take()
    after.markers[:, 1] = 1.0
    faults = [Fault("stuck", 1, 3, 6, 0.1, ""), Fault("stuck", 1, 3, 9, 0.1, ""), Fault("leading gap", 1, 0, 2, NAN, "")]
    assert [change.id for change in list_changes(before, after, *faults)] == [
        "stuck-Jim:B-104",
        "stuck-Jim:B-104-2",
        "leading-gap-Jim:B-101",
    ]


@pytest.mark.parametrize(("donor", "name", "count"), [(2, "A-1", 8), (3, "*4", 4)])
def test_fragment_change_names_its_donor(donor, name, count):
    fragment, before = Fragment("fragment", 0, 5, 8, 0.0, "It continues A.", donor=donor, relation="continues"), build_take()
    after = build_take()
    after.markers[5:9, 0], after.markers[5:9, 2] = 0.0, NAN
    if donor == 3:
        after.markers[5:9, 2] = before.markers[5:9, 2]
    (change,) = list_changes(before, after, fragment)
    assert (change.markers, change.method, change.samples) == (("A", name), f"samples of {name} joined to the marker", count)
    assert list_affected_markers(fragment, 3) == ([0, 2] if donor == 2 else [0])


def test_spike_within_a_swap_is_measured_on_the_markers_own_sample():
    """B's sample is under A's label, 1 m off; A's own sample, under B's label, is 0.2 m off."""
    before = build_take()
    before.markers[12:16, 0], before.markers[12:16, 1, 1] = 1.0, 0.2
    relabelled = before.exchange_labels((0, 1), 12, 15)
    after = relabelled.replace_markers(relabelled.markers.copy())
    after.markers[13, 0] = 0.0
    change = list_changes(
        before, after, SWAP, Fault("spike", 0, 13, 13, 0.2, ""), relabelled=relabelled, body=np.zeros((FRAMES, 3, 3))
    )[1]
    assert (change.before, change.after) == (SampleState(0, 200.0), SampleState(0, 0.0))


def test_samples_from_another_point_differ():
    before = build_take()
    assert compare_samples(before, before.exchange_labels((0, 1), 12, 15)).sum() == 8
    # of each pair one sample is missing before the exchange and the other after it
    assert compare_samples(before, before.exchange_labels((0, 1), 5, 8)).sum() == 8
    assert not compare_samples(before, build_take()).any()


def test_samples_missing_in_both_takes_do_not_differ():
    before = build_take()
    before.markers[5:9, 1] = NAN
    assert not compare_samples(before, before.exchange_labels((0, 1), 5, 8)).any()


masks = arrays(bool, (FRAMES, 3), elements=st.booleans())


@given(
    visible=masks,
    kind=st.sampled_from([*REPLACED_SAMPLE_KINDS, "gap"]),
    marker=st.integers(0, 2),
    a=st.integers(0, 19),
    b=st.integers(0, 19),
)
def test_affected_mask_excludes_missing_samples_of_faulty_kinds(visible, kind, marker, a, b):
    fault = Fault(kind, marker, min(a, b), max(a, b), 0.1, "")
    take = Take(np.where(visible[..., None], 1.0, NAN).repeat(3, 2), tuple("ABC"), 100.0)
    expected = np.zeros(visible.shape, bool)
    expected[fault.first : fault.last + 1, marker] = True
    np.testing.assert_array_equal(build_affected_mask([fault], take), expected if kind == "gap" else expected & visible)


# unfilled runs


def build_visible_take(visible):
    """Return a take with samples where `visible` (T, M) is true."""
    return Take(np.where(visible[..., None], 1.0, np.nan).repeat(3, 2), tuple("ABCDE")[: visible.shape[1]], 100.0)


def test_unfilled_runs_have_one_reason_each():
    visible = np.ones((10, 3), bool)
    visible[2:7, 2] = visible[8:, 2] = visible[5, 0] = False
    reasons = np.full(visible.shape, "", object)
    reasons[2:4, 2] = reasons[5:7, 2] = reasons[8:, 2] = "too far"
    reasons[4, 2] = "uncertain"
    reasons[5, 0] = reasons[0, 0] = "not to be changed"  # the sample in frame 0 is visible
    assert find_unfilled_runs(build_visible_take(visible), reasons) == (
        UnfilledRun(0, 5, 5, "not to be changed"),
        UnfilledRun(2, 2, 3, "too far"),
        UnfilledRun(2, 4, 4, "uncertain"),
        UnfilledRun(2, 5, 6, "too far"),
        UnfilledRun(2, 8, 9, "too far"),
    )


@given(visible=arrays(bool, (12, 3), elements=st.booleans()), choices=arrays(np.int8, (12, 3), elements=st.integers(0, 2)))
def test_every_missing_sample_is_in_one_unfilled_run(visible, choices):
    reasons = np.array(["", "too far", "uncertain"], object)[choices]
    runs = find_unfilled_runs(build_visible_take(visible), reasons)
    assert all((reasons[run.first : run.last + 1, run.marker] == run.reason).all() for run in runs)
    assert not any(visible[run.first : run.last + 1, run.marker].any() for run in runs)
    assert sum(run.last - run.first + 1 for run in runs) == (~visible).sum()
    for run in runs:
        assert UnfilledRun(run.marker, run.last + 1, run.last + 1, run.reason) not in runs
    assert len({(run.marker, run.first) for run in runs}) == len(runs)


def test_complete_take_has_no_unfilled_runs():
    assert find_unfilled_runs(build_visible_take(np.ones((4, 2), bool)), np.full((4, 2), "", object)) == ()

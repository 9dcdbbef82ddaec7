"""The state of every sample, a take before and after cleaning, and the events of its changes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model import windows
from mocapfix.model.changes import Change, SampleState
from mocapfix.model.faults import Faults
from mocapfix.report.sample_states import SampleOutcome, classify_input_samples, find_estimated_samples, group_changes


@pytest.mark.parametrize("block_frames", [7, 1000])
def test_outcome_of_every_sample(scene, block_frames, monkeypatch):
    monkeypatch.setattr(windows, "MAX_BLOCK_FRAMES", block_frames)
    expected = np.full((240, 31), SampleOutcome.MEASURED)
    expected[50:100, 3] = expected[60:70, 29] = SampleOutcome.FILLED
    expected[70:80, 29] = expected[:, 30] = expected[200] = SampleOutcome.EMPTY
    expected[70, 5] = SampleOutcome.REPLACED
    expected[120:140, 7] = SampleOutcome.SUSPECT
    expected[150:170, [10, 11]] = expected[20:40, 12] = SampleOutcome.RELABELLED
    np.testing.assert_array_equal(replace(scene.comparison).sample_states, expected)
    assert find_estimated_samples(expected).sum() == 50 + 10 + 1


def test_samples_moved_to_another_label_are_reassigned_not_empty(scene):
    before, after = scene.comparison.input_take, scene.comparison.cleaned_take
    markers, points = after.markers.copy(), after.source_points.copy()
    markers[5:8, 4], points[5:8, 4], markers[5:8, 2] = before.markers[5:8, 2], 2, np.nan
    cleaned_take = replace(after, markers=markers, relabelled_points=points)
    outcome = scene.replace_comparison(cleaned_take=cleaned_take).comparison.sample_states
    assert (outcome[5:8, 2] == SampleOutcome.REASSIGNED).all()
    assert (outcome[5:8, 4] == SampleOutcome.RELABELLED).all()
    assert (outcome[:5, [2, 4]] == SampleOutcome.MEASURED).all()


def test_input_states_are_suspect_relabelled_or_empty(scene):
    visible, faults = scene.comparison.input_take.visible, scene.comparison.faults
    state = classify_input_samples(visible, scene.comparison.sample_states)
    np.testing.assert_array_equal(state == SampleOutcome.SUSPECT, faults.compute_faulty_mask(scene.comparison.input_take))
    np.testing.assert_array_equal(state == SampleOutcome.EMPTY, ~visible)
    relabelled = state == SampleOutcome.RELABELLED
    assert [column.sum() for column in relabelled.T if column.any()] == [20, 20]


def test_input_sample_of_another_marker_is_not_suspect_where_the_marker_is_filled(scene):
    relabelled = scene.comparison.relabelled_take.markers.copy()
    relabelled[150:155, 10] = np.nan  # M10 was hidden while the other marker had its label
    sample_sd = scene.comparison.cleaned_take.sample_sd.copy()
    sample_sd[150:155, 10] = 0.01
    outcome = scene.replace_comparison(
        relabelled_take=scene.comparison.relabelled_take.replace_markers(relabelled),
        cleaned_take=replace(scene.comparison.cleaned_take, sample_sd=sample_sd),
    ).comparison.sample_states
    assert (outcome[150:155, 10] == SampleOutcome.FILLED).all()
    input_state = classify_input_samples(scene.comparison.input_take.visible, outcome)
    assert (input_state[150:155, 10] == SampleOutcome.RELABELLED).all()


def test_every_change_is_paired_with_its_fault(scene):
    applied = scene.comparison.applied_changes
    assert [(change.kind, fault.kind, fault.marker) for change, fault in applied] == [
        ("gap", "gap", 3),
        ("spike", "spike", 5),
        ("swap", "swap", 10),
        ("fragment", "fragment", 12),
        ("moved", "moved", 20),
        ("gap", "gap", 29),
    ]
    assert [fault.kind for fault in scene.comparison.unchanged_faults] == ["jitter", "absent"]


def test_equal_labels_are_paired_in_order(scene):
    input_take = replace(scene.comparison.input_take, labels=("M",) * 31)
    faults = tuple(replace(scene.comparison.faults.items[0], marker=m) for m in (3, 4))
    change = replace(scene.comparison.changes[0], markers=("M",))
    changes = (change, replace(change, id="other"))
    comparison = scene.replace_comparison(input_take=input_take, faults=Faults(faults), changes=changes).comparison
    assert [(change.id, fault.marker) for change, fault in comparison.applied_changes] == [(change.id, 3), ("other", 4)]


def test_declined_changes_are_not_applied_and_their_faults_are_not_unchanged(scene):
    nothing = SampleState(0, None)
    without_fault = replace(scene.comparison.changes[0], first=102, before=nothing, after=nothing, decision="keep")
    rejected = replace(scene.comparison.changes[1], decision="reject")
    changes = (scene.comparison.changes[0], rejected, *scene.comparison.changes[2:], without_fault)
    comparison = scene.replace_comparison(changes=changes).comparison
    assert [change.kind for change, _ in comparison.applied_changes] == ["gap", "swap", "fragment", "moved", "gap"]
    assert [fault.kind for fault in comparison.unchanged_faults] == ["jitter", "absent"]  # without the rejected spike


def test_joined_fragments_are_listed_by_donor(scene):
    (donor,) = scene.comparison.fragments_by_donor
    assert donor == 31
    assert [each.marker for each in scene.comparison.fragments_by_donor[donor]] == [12]


LIMB = ("LELB", "LWRA", "LFIN")
EVENT_LABELS = (*LIMB, "RKNE")


def place_markers(distance_m=0.3):
    """Return the positions (20, 4, 3) of an arm, each marker at this distance from the next, and of a far knee."""
    places = np.array([[0, 0, 0], [distance_m, 0, 0], [2 * distance_m, 0, 0], [5, 0, 0]], float)
    return np.tile(places, (20, 1, 1)) + np.random.default_rng(0).normal(0, 1e-3, (20, 4, 3))


def make_change(marker, first, last):
    state = SampleState(0, None)
    return Change(f"gap-{marker}-{first}", "gap", (marker,), first, last, 1, "", "", state, state, None)


def test_lost_arm_is_one_event_and_a_far_marker_another():
    arm = tuple(make_change(label, 10 + n, 60) for n, label in enumerate(LIMB))
    knee = make_change("RKNE", 10, 60)
    assert group_changes([knee, *reversed(arm)], EVENT_LABELS, place_markers()) == [(knee,), arm]
    assert len(group_changes(arm, EVENT_LABELS, place_markers(0.5))) == 3


def test_short_gap_within_a_long_one_of_a_neighbour_is_an_event_of_its_own():
    events = group_changes([make_change("LELB", 0, 99), make_change("LWRA", 40, 45)], EVENT_LABELS, place_markers())
    assert [len(each) for each in events] == [1, 1]


@given(
    st.lists(st.tuples(st.sampled_from((*EVENT_LABELS, "*1")), st.integers(0, 60), st.integers(0, 40)), max_size=30), st.randoms()
)
def test_each_change_is_in_one_event_whatever_their_order(intervals, random):
    changes = [make_change(label, first, first + length) for label, first, length in intervals]
    events = group_changes(changes, EVENT_LABELS, place_markers())
    assert sorted(map(id, changes)) == sorted(id(change) for each in events for change in each)
    shuffled = random.sample(changes, len(changes))
    again = group_changes(shuffled, EVENT_LABELS, place_markers())
    assert {frozenset(map(id, each)) for each in again} == {frozenset(map(id, each)) for each in events}

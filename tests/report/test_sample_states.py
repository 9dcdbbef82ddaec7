"""The state of every sample, and a take before and after cleaning."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model import windows
from mocapfix.model.changes import SampleState
from mocapfix.model.faults import Faults
from mocapfix.report.sample_states import SampleOutcome, classify_input_samples, find_estimated_samples


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

from dataclasses import replace

from mocapfix.changes import SampleState
from mocapfix.faults import Faults


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

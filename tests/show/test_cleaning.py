from dataclasses import replace

from mocapfix.changes import SampleState
from mocapfix.faults import Faults


def test_every_change_finds_its_fault(scene):
    made = scene.comparison.made
    assert [(change.kind, fault.kind, fault.marker) for change, fault in made] == [
        ("gap", "gap", 3),
        ("spike", "spike", 5),
        ("swap", "swap", 10),
        ("fragment", "fragment", 12),
        ("moved", "moved", 20),
        ("gap", "gap", 29),
    ]
    assert [fault.kind for fault in scene.comparison.unchanged_faults] == ["jitter", "absent"]


def test_two_markers_of_one_name_each_have_their_own(scene):
    before = replace(scene.comparison.before, labels=("M",) * 31)
    faults = tuple(replace(scene.comparison.faults.items[0], marker=m) for m in (3, 4))
    change = replace(scene.comparison.changes[0], markers=("M",))
    cleaning = scene.with_(before=before, faults=Faults(faults), changes=(change, replace(change, id="other"))).comparison
    assert [(change.id, fault.marker) for change, fault in cleaning.made] == [(change.id, 3), ("other", 4)]


def test_a_change_that_is_only_remembered_has_no_fault_and_is_not_made(scene):
    nothing = SampleState(0, None)
    gone = replace(scene.comparison.changes[0], first=102, before=nothing, after=nothing, decision="keep")
    rejected = replace(scene.comparison.changes[1], decision="reject")
    cleaning = scene.with_(changes=(scene.comparison.changes[0], rejected, *scene.comparison.changes[2:], gone)).comparison
    assert [change.kind for change, _ in cleaning.made] == ["gap", "swap", "fragment", "moved", "gap"]
    assert [fault.kind for fault in cleaning.unchanged_faults] == ["jitter", "absent"]  # not the spike: somebody decided so


def test_what_was_taken_over_is_known_by_its_donor(scene):
    (donor,) = scene.comparison.donors
    assert donor == 31
    assert [each.marker for each in scene.comparison.donors[donor]] == [12]

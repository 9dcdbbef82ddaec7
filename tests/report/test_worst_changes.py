from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model import changes
from mocapfix.model.faults import Fault, Faults
from mocapfix.report.change_figures import MAX_CHANGE_FIGURES, select_worst_changes


def test_worst_changes_come_first_and_include_every_kind(scene):
    comparison = scene.comparison
    jitter = tuple(Fault("jitter", m, 10, 20 + m, 0.05, "") for m in range(8, 28))
    short = (Fault("spike", 5, 70, 70, 0.3, ""), Fault("spike", 5, 71, 71, 0.2, ""), Fault("stuck", 6, 3, 5, 0.01, ""))
    faults = (*short, *jitter)
    markers = comparison.cleaned_take.markers.copy()
    for fault in faults:
        markers[fault.frame_slice, fault.marker] += 0.001
    cleaned_take = comparison.cleaned_take.replace_markers(markers, None)
    methods = np.full((240, 31), "", object)
    made = changes.build_changes(comparison.input_take, comparison.relabelled_take, cleaned_take, faults, None, methods)
    fields = {"cleaned_take": cleaned_take, "faults": Faults(faults), "changes": tuple(change for change, _ in made)}
    selected = select_worst_changes(scene.replace_comparison(**fields).comparison)
    assert len(selected) == MAX_CHANGE_FIGURES
    assert [(c.kind, c.markers[0]) for c, _ in selected[:3]] == [("jitter", "M27"), ("jitter", "M26"), ("jitter", "M25")]
    assert [(c.kind, c.first) for c, _ in selected[-2:]] == [("spike", 171), ("stuck", 104)]
    assert all(change.first == comparison.input_take.get_frame_number(fault.first) for change, fault in selected)


def test_gaps_are_sorted_by_duration_and_uncertainty_not_by_travelled_distance(scene):
    first, second = scene.comparison.changes[0], scene.comparison.changes[-1]
    assert (first.markers, second.markers) == (("M03",), ("<b>&\"'",))
    gaps = [c.id for c, _ in select_worst_changes(scene.comparison) if c.kind == "gap"]
    assert gaps == [first.id, second.id]  # 0.42 s before 0.17 s
    uncertain = (first, *scene.comparison.changes[1:-1], replace(second, predicted_mm=100.0))
    worst = select_worst_changes(scene.replace_comparison(changes=uncertain).comparison)
    assert [c.id for c, _ in worst if c.kind == "gap"] == [second.id, first.id]


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_declined_changes_are_not_selected(scene, decision):
    declined = tuple(replace(change, decision=decision) for change in scene.comparison.changes)
    assert select_worst_changes(scene.replace_comparison(changes=declined).comparison) == []

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import changes
from mocapfix.faults import Fault, Faults
from mocapfix.report.change_sections import MAX_CHANGE_FIGURES, select_worst_changes


def test_every_kind_is_there_and_the_worst_come_first(scene):
    cleaning = scene.comparison
    long = tuple(Fault("jitter", m, 10, 20 + m, 0.05, "") for m in range(8, 28))
    short = (Fault("spike", 5, 70, 70, 0.3, ""), Fault("spike", 5, 71, 71, 0.2, ""), Fault("stuck", 6, 3, 5, 0.01, ""))
    faults = (*short, *long)
    seen = cleaning.after.markers.copy()
    for fault in faults:
        seen[fault.frame_slice, fault.marker] += 0.001
    after = cleaning.after.replace_markers(seen, None)
    made = tuple(
        change
        for change, _ in changes.build_changes(
            cleaning.before, cleaning.relabelled, after, faults, None, np.full((240, 31), "", object)
        )
    )
    chosen = select_worst_changes(scene.with_(after=after, faults=Faults(faults), changes=made).comparison)
    assert len(chosen) == MAX_CHANGE_FIGURES
    assert [(c.kind, c.markers[0]) for c, _ in chosen[:3]] == [("jitter", "M27"), ("jitter", "M26"), ("jitter", "M25")]
    assert [(c.kind, c.first) for c, _ in chosen[-2:]] == [("spike", 171), ("stuck", 104)]
    assert all(change.first == cleaning.before.get_frame_number(fault.first) for change, fault in chosen)


def test_of_gaps_those_come_first_whose_fill_is_long_and_unsure_however_far_the_marker_went(scene):
    first, second = scene.comparison.changes[0], scene.comparison.changes[-1]
    assert (first.markers, second.markers) == (("M03",), ("<b>&\"'",))
    assert [c.id for c, _ in select_worst_changes(scene.comparison) if c.kind == "gap"] == [
        first.id,
        second.id,
    ]  # 0.42 s before 0.17 s
    changes = (first, *scene.comparison.changes[1:-1], replace(second, predicted_mm=100.0))
    assert [c.id for c, _ in select_worst_changes(scene.with_(changes=changes).comparison) if c.kind == "gap"] == [
        second.id,
        first.id,
    ]


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_what_was_not_made_is_not_among_them(scene, decision):
    against = tuple(replace(change, decision=decision) for change in scene.comparison.changes)
    assert select_worst_changes(scene.with_(changes=against).comparison) == []

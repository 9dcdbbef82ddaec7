from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.changes import SampleState, build_affected_mask, build_changes, compare_samples, list_affected_markers
from mocapfix.faults import REPLACED_SAMPLE_KINDS, Fault, Fragment, MarkerShift
from mocapfix.take import Take

NAN = np.nan
FRAMES = 20


def take() -> Take:
    """A (missing in 5-8), B and A-1 (visible in 5-8 only), numbered from 101, and the unlabelled *4."""
    markers = np.zeros((FRAMES, 3, 3))
    markers[5:9, 0] = markers[:5, 2] = markers[9:, 2] = NAN
    loose = Take(np.ones((FRAMES, 1, 3)), ("*4",), 100.0, point_columns=np.array([3]))
    return Take(markers, ("A", "Jim:B", "A-1"), 100.0, 101, point_columns=np.arange(3), unlabelled=loose)


def entries(before, after, *faults, labelled=None, body=None):
    ways = np.where(compare_samples(before, after) & after.visible, "the body", "")
    return [change for change, _ in build_changes(before, labelled or before, after, faults, body, ways)]


GAP = Fault("gap", 0, 5, 8, 0.1, "A is missing.")
SWAP = Fault("swap", 0, 12, 15, 0.1, "Exchanged.", 1.0, (1,))


def test_change_has_file_frame_numbers_and_states():
    before, after = take(), take()
    after.markers[5:9, 0] = [0.003, 0.0, 0.0]
    deviation = np.full((FRAMES, 3), NAN)
    deviation[5:9, 0] = 0.002
    body = np.zeros((FRAMES, 3, 3))
    (change,) = entries(before, replace(after, sample_sd=deviation), GAP, body=body)
    assert (change.id, change.kind, change.markers, change.first, change.last) == ("gap-A-106", "gap", ("A",), 106, 109)
    assert (change.samples, change.why, change.decision) == (4, "A is missing.", "accept")
    assert (change.before, change.after) == (SampleState(4, None), SampleState(0, 3.0))
    assert change.predicted_mm == pytest.approx(np.sqrt(3) * 2.0, abs=0.05)  # a distance: three axes
    assert change.method == "estimated, mostly from the body"


def test_fault_without_effect_is_no_change_unless_it_is_a_shift():
    knocked = MarkerShift("moved", 1, 10, 19, 0.04, "Knocked.", settled_frame=10)
    assert [change.kind for change in entries(take(), take(), GAP, SWAP, knocked)] == ["moved"]


def test_method_of_removed_samples():
    after = take()
    after.markers[3, 1] = NAN
    (change,) = entries(take(), after, Fault("ghost", 1, 3, 3, 0.1, ""))
    assert (change.method, change.before.missing, change.after.missing) == ("removed", 0, 1)


def test_change_ids_are_unique_and_without_blanks():
    before, after = take(), take()
    after.markers[:, 1] = 1.0
    twice = [Fault("stuck", 1, 3, 6, 0.1, ""), Fault("stuck", 1, 3, 9, 0.1, ""), Fault("leading gap", 1, 0, 2, NAN, "")]
    assert [change.id for change in entries(before, after, *twice)] == [
        "stuck-Jim:B-104",
        "stuck-Jim:B-104-2",
        "leading-gap-Jim:B-101",
    ]


@pytest.mark.parametrize(("donor", "name", "count"), [(2, "A-1", 8), (3, "*4", 4)])
def test_fragment_change_names_its_donor(donor, name, count):
    fragment, before = Fragment("fragment", 0, 5, 8, 0.0, "Goes on.", donor=donor, relation="continues"), take()
    after = take()
    after.markers[5:9, 0], after.markers[5:9, 2] = 0.0, NAN
    if donor == 3:
        after.markers[5:9, 2] = before.markers[5:9, 2]
    (change,) = entries(before, after, fragment)
    assert (change.markers, change.method, change.samples) == (("A", name), f"samples of {name} joined to the marker", count)
    assert list_affected_markers(fragment, 3) == ([0, 2] if donor == 2 else [0])


def test_spike_within_a_swap_is_measured_on_the_markers_own_sample():
    """B's sample is under A's label, 1 m off; A's own sample, under B's label, is 0.2 m off."""
    before = take()
    before.markers[12:16, 0], before.markers[12:16, 1, 1] = 1.0, 0.2
    labelled = before.exchange_labels((0, 1), 12, 15)
    after = labelled.replace_markers(labelled.markers.copy())
    after.markers[13, 0] = 0.0
    change = entries(before, after, SWAP, Fault("spike", 0, 13, 13, 0.2, ""), labelled=labelled, body=np.zeros((FRAMES, 3, 3)))[1]
    assert (change.before, change.after) == (SampleState(0, 200.0), SampleState(0, 0.0))


def test_samples_from_another_point_differ():
    before = take()
    assert compare_samples(before, before.exchange_labels((0, 1), 12, 15)).sum() == 8
    assert (
        compare_samples(before, before.exchange_labels((0, 1), 5, 8)).sum() == 8
    )  # one of the two is missing before, the other after
    assert not compare_samples(before, take()).any()


def test_samples_missing_in_both_takes_do_not_differ():
    before = take()
    before.markers[5:9, 1] = NAN
    assert not compare_samples(before, before.exchange_labels((0, 1), 5, 8)).any()


masks = arrays(bool, (FRAMES, 3), elements=st.booleans())


@given(
    seen=masks,
    kind=st.sampled_from([*REPLACED_SAMPLE_KINDS, "gap"]),
    marker=st.integers(0, 2),
    a=st.integers(0, 19),
    b=st.integers(0, 19),
)
def test_affected_mask_excludes_missing_samples_of_faulty_kinds(seen, kind, marker, a, b):
    fault = Fault(kind, marker, min(a, b), max(a, b), 0.1, "")
    shown = Take(np.where(seen[..., None], 1.0, NAN).repeat(3, 2), tuple("ABC"), 100.0)
    wanted = np.zeros(seen.shape, bool)
    wanted[fault.first : fault.last + 1, marker] = True
    np.testing.assert_array_equal(build_affected_mask(fault, shown), wanted if kind == "gap" else wanted & seen)

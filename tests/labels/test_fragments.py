from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.io import capture
from mocapfix.labels import fragments
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take
from tests.captures import CAPTURES, needs_captures


@cache
def whole(seed=5) -> Take:
    truth = compose_take(seed=seed, seconds=6.0)
    return Take(truth.marker_positions, truth.labels, truth.rate)


def take_of(take, trajectories):
    """Add unlabelled trajectories (T, 3), named *0, *1 ..."""
    loose = np.stack(trajectories, axis=1)
    return replace(take, unlabelled=Take(loose, tuple(f"*{i}" for i in range(len(trajectories))), take.rate))


def cut(take, *intervals):
    """Move the samples of intervals (label, first, last) to unlabelled trajectories."""
    markers, loose = take.markers.copy(), []
    for label, first, last in intervals:
        m = take.labels.index(label)
        loose.append(np.full((take.frame_count, 3), np.nan))
        loose[-1][first : last + 1] = markers[first : last + 1, m]
        markers[first : last + 1, m] = np.nan
    return take_of(take.replace_markers(markers), loose)


def classify(take):
    """Return the relation, the marker's label ("" for none), the first and the last frame of every fragment."""
    return [
        (f.relation, take.labels[f.marker] if f.marker != f.donor else "", f.first, f.last)
        for f in fragments.detect_fragments(take)
    ]


@given(marker=st.integers(0, 40), first=st.integers(0, 300), length=st.integers(6, 150))
def test_unlabelled_continuation_is_found(marker, first, length):
    take, last = whole(), first + length - 1
    (fragment,) = fragments.detect_fragments(cut(take, (take.labels[marker], first, last)))
    assert (fragment.relation, fragment.marker, fragment.first, fragment.last) == ("continues", marker, first, last)
    assert fragment.donor == len(take.labels)
    assert fragment.confidence > 0.9


def test_reason_names_marker_duration_and_partners():
    (fragment,) = fragments.detect_fragments(cut(whole(), ("LFHD", 100, 219)))
    assert fragment.reason.startswith("*0 continues LFHD for 1.00 s: its distances to ")
    assert "LBHD" in fragment.reason
    assert 0 < fragment.severity < 0.01
    assert f"within {fragment.severity * 1e3:.0f} mm" in fragment.reason


def test_neighbours_missing_together_are_not_confused():
    lost = [("LWRA", 100, 220), ("LWRB", 110, 260), ("LFIN", 90, 200), ("LFHD", 300, 400), ("RFHD", 300, 400), ("LBHD", 310, 390)]
    assert classify(cut(whole(), *lost)) == [("continues", *each) for each in lost]


def test_comparisons_that_a_join_cannot_change_are_kept(monkeypatch):
    """As if each segment were compared with each marker again after each join."""
    lost = [("LWRA", 100, 220), ("LWRB", 110, 260), ("LFIN", 90, 200), ("LELB", 100, 160), ("LELB", 170, 230), ("RKNE", 50, 90)]
    take = cut(whole(), *lost)
    found, update = fragments.detect_fragments(take), fragments.RigidSignatures.update_markers

    def update_all(signatures, changed):
        return np.ones_like(update(signatures, changed))

    monkeypatch.setattr(fragments.RigidSignatures, "update_markers", update_all)
    assert fragments.detect_fragments(take) == found
    assert len(found) == len(lost)


def test_several_segments_continue_one_marker():
    """Segments of one trajectory with pauses, and of several trajectories."""
    take = cut(whole(), ("LELB", 100, 300), ("LELB", 310, 400))
    assert take.unlabelled is not None
    take.unlabelled.markers[200:220, 0] = np.nan
    assert classify(take) == [("continues", "LELB", 100, 199), ("continues", "LELB", 220, 300), ("continues", "LELB", 310, 400)]


def test_the_better_of_two_simultaneous_segments_is_joined():
    take = cut(whole(), ("RKNE", 200, 300))
    own = take.unlabelled.markers[:, 0]
    ghost = own + [0.0, 0.03, 0.0]
    assert classify(take_of(take, [ghost, own])) == [("other", "", 200, 300), ("continues", "RKNE", 200, 300)]


def test_segment_may_begin_while_the_marker_is_visible():
    take = whole()
    m = take.labels.index("STRN")
    path = np.where((np.arange(take.frame_count) >= 195)[:, None], take.markers[:, m], np.nan)
    markers = take.markers.copy()
    markers[200:, m] = np.nan
    assert classify(take_of(take.replace_markers(markers), [path + 0.001])) == [("continues", "STRN", 195, 719)]
    assert classify(take_of(take.replace_markers(markers), [path + 0.020])) == [("other", "", 195, 719)]


def test_duplicate_is_not_joined():
    take, path = whole(), np.full((720, 3), np.nan)
    path[100:200] = take.markers[100:200, take.labels.index("LTOE")] + [0.004, 0.0, 0.0]
    (fragment,) = fragments.detect_fragments(take_of(take, [path]))
    assert (fragment.relation, take.labels[fragment.marker]) == ("doubles", "LTOE")
    assert fragment.severity == pytest.approx(0.004)
    assert fragment.reason == "*0 duplicates LTOE for 0.83 s at a distance of 4 mm."


def test_smoother_duplicate_replaces_the_marker():
    take = whole()
    m, markers, path = take.labels.index("T10"), take.markers.copy(), np.full((720, 3), np.nan)
    path[100:130] = markers[100:130, m]
    markers[100:130, m] += [0.0, 0.006, 0.0]
    assert classify(take_of(take.replace_markers(markers), [path])) == [("replaces", "T10", 100, 129)]


def test_unassigned_segments_are_described():
    take, t = whole(), np.arange(720)[:, None] / 120
    still = np.tile([1.0, 0.5, 1.0], (720, 1))
    head = take.markers[:, [take.labels.index(label) for label in ("LFHD", "RFHD", "LBHD", "RBHD")]].mean(1)
    alone = take.markers[:, 0] + np.sin([3.0, 4.0, 5.0] * t)
    glint = np.full((720, 3), np.nan)
    glint[[50, 90, 130]] = 1.0
    found = fragments.detect_fragments(take_of(take, [still, head, alone, glint]))
    assert [(f.relation, f.donor - len(take.labels)) for f in found] == [("other", i) for i in range(4)]
    expected = ["it is stationary.", "it moves rigidly with ", "it moves independently.", "all 3 successive segments."]
    assert [f.reason for f, words in zip(found, expected, strict=True) if words not in f.reason] == []
    assert (found[3].first, found[3].last) == (50, 130)


def test_ghost_is_not_joined():
    take = whole()
    lost = cut(take, ("RFIN", 200, 400))
    ghost = lost.unlabelled.markers[:, 0] + [0.0, 0.1, 0.0]
    (fragment,) = fragments.detect_fragments(take_of(lost, [ghost]))
    assert fragment.relation == "other"
    assert "of the markers missing at that time, RFIN fits best, but its distances to " in fragment.reason


def test_ambiguous_segment_is_not_joined():
    """Two of the markers are almost in the same place."""
    rng, t = np.random.default_rng(0), np.arange(600)[:, None, None] / 120
    place = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.4, 0], [0.1, 0.1, 0.25], [0.1, 0.1, 0.252]])
    take = Take(place + np.sin(t * [1.0, 2.0, 3.0]) + rng.normal(0, 0.0005, (600, 5, 3)), tuple("ABCDE"), 120.0)
    lost = cut(take, ("D", 200, 400), ("E", 200, 400))
    (fragment,) = fragments.detect_fragments(take_of(lost, [lost.unlabelled.markers[:, 0]]))
    assert fragment.relation == "other"
    assert fragment.reason.endswith(": D and E are both missing at that time, and either may match.")


def test_numbered_label_continues_its_namesake():
    take = cut(whole(), ("RBAC", 300, 420))
    markers = np.concatenate([take.markers, take.unlabelled.markers], axis=1)
    named = Take(markers, (*take.labels, "RBAC-1"), take.rate)
    assert classify(named) == [("continues", "RBAC", 300, 420)]


def test_numbered_label_continues_no_other_marker():
    take = cut(whole(), ("LELB", 300, 420), ("RBAC", 300, 420))
    assert take.unlabelled is not None
    named = Take(np.concatenate([take.markers, take.unlabelled.markers[:, :1]], axis=1), (*take.labels, "RBAC-1"), take.rate)
    assert classify(named) == [("other", "", 300, 420)]
    named.markers[:, take.labels.index("RBAC")] = whole().markers[:, take.labels.index("RBAC")]
    (fragment,) = fragments.detect_fragments(named)
    assert fragment.reason == "RBAC-1 matches no missing marker (1.01 s): RBAC is visible elsewhere at that time."


@pytest.mark.parametrize("rate", [60.0, 240.0])
def test_result_does_not_depend_on_the_frame_rate(rate):
    truth = compose_take(seed=8, seconds=4.0, rate=rate)
    first, last = round(1.2 * rate), round(2.0 * rate)
    assert classify(cut(Take(truth.marker_positions, truth.labels, rate), ("LANK", first, last))) == [
        ("continues", "LANK", first, last)
    ]


def test_take_without_loose_trajectories_has_no_fragments():
    assert fragments.detect_fragments(whole()) == []


def test_single_marker_is_matched_by_its_path():
    t = np.arange(240)[:, None, None] / 120
    take = Take(np.sin(t * [1.0, 2.0, 3.0]), ("Ball",), 120.0)
    assert classify(cut(take, ("Ball", 100, 160))) == [("continues", "Ball", 100, 160)]


@needs_captures
def test_fragment_of_a_capture():
    take = capture.read_take(CAPTURES / "cmu" / "01_01.c3d")
    (fragment,) = fragments.detect_fragments(take)
    assert take.labels[fragment.donor] == "RBAC-1"
    assert (fragment.relation, take.labels[fragment.marker], fragment.first, fragment.last) == ("replaces", "RBAC", 120, 127)


@needs_captures
def test_additional_markers_of_a_capture_are_not_joined():
    take = capture.read_take(CAPTURES / "c3d" / "Movement_trial.c3d")
    found = fragments.detect_fragments(take)
    assert {f.donor for f in found} == set(range(39, 81))  # each of the 42 is accounted for
    assert {f.relation for f in found} == {"other", "doubles"}
    assert sum("moves rigidly with" in f.reason for f in found) >= 36

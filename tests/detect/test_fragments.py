from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import synthetic
from mocapfix.detect import fragments
from mocapfix.read import capture
from mocapfix.take import Take

CAPTURES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures"
with_captures = pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")


@cache
def whole(seed=5) -> Take:
    truth = synthetic.compose_take(seed=seed, seconds=6.0)
    return Take(truth.marker_positions, truth.labels, truth.rate)


def take_of(take, trajectories):
    """-> the take with unlabelled trajectories (T, 3), named *0, *1 ..."""
    loose = np.stack(trajectories, axis=1)
    return replace(take, unlabelled=Take(loose, tuple(f"*{i}" for i in range(len(trajectories))), take.rate))


def cut(take, *intervals):
    """-> the take whose markers go on unlabelled over intervals (label, first, last)."""
    markers, loose = take.markers.copy(), []
    for label, first, last in intervals:
        m = take.labels.index(label)
        loose.append(np.full((take.frame_count, 3), np.nan))
        loose[-1][first : last + 1] = markers[first : last + 1, m]
        markers[first : last + 1, m] = np.nan
    return take_of(take.replace_markers(markers), loose)


def told(take):
    """-> kind, marker's label ("" for none), first and last frame of every fragment."""
    return [
        (f.relation, take.labels[f.marker] if f.marker != f.donor else "", f.first, f.last)
        for f in fragments.detect_fragments(take)
    ]


@given(marker=st.integers(0, 40), first=st.integers(0, 300), length=st.integers(6, 150))
def test_a_marker_that_goes_on_unlabelled_is_found_again(marker, first, length):
    take, last = whole(), first + length - 1
    (fragment,) = fragments.detect_fragments(cut(take, (take.labels[marker], first, last)))
    assert (fragment.relation, fragment.marker, fragment.first, fragment.last) == ("continues", marker, first, last)
    assert fragment.donor == len(take.labels)
    assert fragment.confidence > 0.9


def test_the_reason_says_who_for_how_long_and_by_whose_distances():
    (fragment,) = fragments.detect_fragments(cut(whole(), ("LFHD", 100, 219)))
    assert fragment.reason.startswith("*0 goes on as LFHD for 1.00 s: its distances to ")
    assert "LBHD" in fragment.reason
    assert 0 < fragment.severity < 0.01
    assert f"within {fragment.severity * 1e3:.0f} mm" in fragment.reason


def test_neighbours_lost_together_are_not_mistaken_for_each_other():
    lost = [("LWRA", 100, 220), ("LWRB", 110, 260), ("LFIN", 90, 200), ("LFHD", 300, 400), ("RFHD", 300, 400), ("LBHD", 310, 390)]
    assert told(cut(whole(), *lost)) == [("continues", *each) for each in lost]


def test_several_pieces_serve_one_marker_one_after_the_other():
    """Under one label with pauses, and under several."""
    take = cut(whole(), ("LELB", 100, 300), ("LELB", 310, 400))
    assert take.unlabelled is not None
    take.unlabelled.markers[200:220, 0] = np.nan
    assert told(take) == [("continues", "LELB", 100, 199), ("continues", "LELB", 220, 300), ("continues", "LELB", 310, 400)]


def test_of_two_pieces_at_once_a_marker_is_given_the_right_one():
    take = cut(whole(), ("RKNE", 200, 300))
    own = take.unlabelled.markers[:, 0]
    ghost = own + [0.0, 0.03, 0.0]
    assert told(take_of(take, [ghost, own])) == [("other", "", 200, 300), ("continues", "RKNE", 200, 300)]


def test_a_piece_may_begin_while_the_marker_is_still_seen():
    take = whole()
    m = take.labels.index("STRN")
    path = np.where((np.arange(take.frame_count) >= 195)[:, None], take.markers[:, m], np.nan)
    markers = take.markers.copy()
    markers[200:, m] = np.nan
    assert told(take_of(take.replace_markers(markers), [path + 0.001])) == [("continues", "STRN", 195, 719)]
    assert told(take_of(take.replace_markers(markers), [path + 0.020])) == [("other", "", 195, 719)]


def test_a_marker_seen_twice_is_no_fragment():
    take, path = whole(), np.full((720, 3), np.nan)
    path[100:200] = take.markers[100:200, take.labels.index("LTOE")] + [0.004, 0.0, 0.0]
    (fragment,) = fragments.detect_fragments(take_of(take, [path]))
    assert (fragment.relation, take.labels[fragment.marker]) == ("doubles", "LTOE")
    assert fragment.severity == pytest.approx(0.004)
    assert fragment.reason == "*0 is LTOE a second time for 0.83 s, 4 mm beside it."


def test_the_smoother_of_two_replaces_the_other():
    take = whole()
    m, markers, path = take.labels.index("T10"), take.markers.copy(), np.full((720, 3), np.nan)
    path[100:130] = markers[100:130, m]
    markers[100:130, m] += [0.0, 0.006, 0.0]
    assert told(take_of(take.replace_markers(markers), [path])) == [("replaces", "T10", 100, 129)]


def test_what_continues_nothing_is_told_apart():
    take, t = whole(), np.arange(720)[:, None] / 120
    still = np.tile([1.0, 0.5, 1.0], (720, 1))
    head = take.markers[:, [take.labels.index(label) for label in ("LFHD", "RFHD", "LBHD", "RBHD")]].mean(1)
    alone = take.markers[:, 0] + np.sin([3.0, 4.0, 5.0] * t)
    glint = np.full((720, 3), np.nan)
    glint[[50, 90, 130]] = 1.0
    found = fragments.detect_fragments(take_of(take, [still, head, alone, glint]))
    assert [(f.relation, f.donor - len(take.labels)) for f in found] == [("other", i) for i in range(4)]
    told = ["it stands still.", "it rides on the body with ", "it moves by itself.", "so with its 3 pieces in a row."]
    assert [f.reason for f, words in zip(found, told, strict=True) if words not in f.reason] == []
    assert (found[3].first, found[3].last) == (50, 130)


def test_a_ghost_is_not_joined_to_what_is_missing():
    take = whole()
    lost = cut(take, ("RFIN", 200, 400))
    ghost = lost.unlabelled.markers[:, 0] + [0.0, 0.1, 0.0]
    (fragment,) = fragments.detect_fragments(take_of(lost, [ghost]))
    assert fragment.relation == "other"
    assert "the likeliest of those missing meanwhile is RFIN, and it is " in fragment.reason


def test_of_two_who_fit_alike_neither_is_chosen():
    """Four markers on a cross, two of which never come apart."""
    rng, t = np.random.default_rng(0), np.arange(600)[:, None, None] / 120
    place = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.4, 0], [0.1, 0.1, 0.25], [0.1, 0.1, 0.252]])
    take = Take(place + np.sin(t * [1.0, 2.0, 3.0]) + rng.normal(0, 0.0005, (600, 5, 3)), tuple("ABCDE"), 120.0)
    lost = cut(take, ("D", 200, 400), ("E", 200, 400))
    (fragment,) = fragments.detect_fragments(take_of(lost, [lost.unlabelled.markers[:, 0]]))
    assert fragment.relation == "other"
    assert fragment.reason.endswith(": D and E are missing meanwhile, and it may be either.")


def test_a_label_with_a_number_added_belongs_to_the_label():
    take = cut(whole(), ("RBAC", 300, 420))
    markers = np.concatenate([take.markers, take.unlabelled.markers], axis=1)
    named = Take(markers, (*take.labels, "RBAC-1"), take.rate)
    assert told(named) == [("continues", "RBAC", 300, 420)]


def test_a_numbered_label_is_no_other_markers():
    take = cut(whole(), ("LELB", 300, 420), ("RBAC", 300, 420))
    assert take.unlabelled is not None
    named = Take(np.concatenate([take.markers, take.unlabelled.markers[:, :1]], axis=1), (*take.labels, "RBAC-1"), take.rate)
    assert told(named) == [("other", "", 300, 420)]
    named.markers[:, take.labels.index("RBAC")] = whole().markers[:, take.labels.index("RBAC")]
    (fragment,) = fragments.detect_fragments(named)
    assert fragment.reason == "RBAC-1 continues no marker in its 1.01 s: RBAC is seen meanwhile, elsewhere."


@pytest.mark.parametrize("rate", [60.0, 240.0])
def test_seconds_count_and_not_frames(rate):
    truth = synthetic.compose_take(seed=8, seconds=4.0, rate=rate)
    first, last = round(1.2 * rate), round(2.0 * rate)
    assert told(cut(Take(truth.marker_positions, truth.labels, rate), ("LANK", first, last))) == [
        ("continues", "LANK", first, last)
    ]


def test_nothing_loose_nothing_found():
    assert fragments.detect_fragments(whole()) == []


def test_a_take_of_one_marker_goes_by_its_course():
    t = np.arange(240)[:, None, None] / 120
    take = Take(np.sin(t * [1.0, 2.0, 3.0]), ("Ball",), 120.0)
    assert told(cut(take, ("Ball", 100, 160))) == [("continues", "Ball", 100, 160)]


@with_captures
def test_a_captures_fragment_is_its_markers():
    take = capture.read_capture(CAPTURES / "cmu" / "01_01.c3d")
    (fragment,) = fragments.detect_fragments(take)
    assert take.labels[fragment.donor] == "RBAC-1"
    assert (fragment.relation, take.labels[fragment.marker], fragment.first, fragment.last) == ("replaces", "RBAC", 120, 127)


@with_captures
def test_a_captures_other_markers_continue_none():
    take = capture.read_capture(CAPTURES / "c3d" / "Movement_trial.c3d")
    found = fragments.detect_fragments(take)
    assert {f.donor for f in found} == set(range(39, 81))  # each of the 42 is accounted for
    assert {f.relation for f in found} == {"other", "doubles"}
    assert sum("rides on the body" in f.reason for f in found) >= 36

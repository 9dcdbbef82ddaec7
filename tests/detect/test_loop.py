"""Looking: what the first look puts right and in which order, and what a look at the body adds and takes away."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import marker_sets, repair
from mocapfix.detect import loop
from mocapfix.detect.loop import DetectionState
from mocapfix.faults import Fault, Faults, Fragment, MarkerShift
from mocapfix.read import capture
from mocapfix.state import BodyFit
from mocapfix.take import Take
from tests.muddled import columns

NAN = np.nan


def anything(fault):
    return True


@pytest.fixture(scope="module")
def looked(muddled):
    take = capture.read_capture(muddled.path)
    return loop.detect_on_trajectories(take, marker_sets.build_subject_marker_set(muddled.subject), muddled.subject, anything)


def test_labels_are_put_right_first_and_what_is_under_them_is_judged_then(muddled, looked):
    labels = looked.take.labels
    assert [(f.kind, labels[f.marker], f.first, f.last) for f in looked.label_faults] == [
        ("fragment", "RFHD", 100, 159),
        ("fragment", "RHEE", 150, 199),
        ("swap", "LWRA", 220, 289),
    ]
    assert {(f.kind, labels[f.marker], f.first, f.last) for f in looked.sample_faults.items} == {
        ("spike", "STRN", 20, 20),
        ("gap", "RELB", 40, 59),
        ("spike", "LWRB", 250, 250),  # in the file it is under LWRA
    }
    off = np.linalg.norm(looked.take.markers[:, :-1] - muddled.truth, axis=-1)
    assert np.nanmax(np.where(looked.inlier_take.visible[:, :-1], off, NAN)) < 1e-6


def test_what_only_names_a_piece_of_another_is_neither_judged_nor_believed_of_it(looked):
    assert [looked.take.labels[m] for m in looked.donor_markers] == ["RFHD-1"]
    assert not any(fault.marker in looked.donor_markers for fault in looked.sample_faults.items)


def test_what_somebody_vouches_for_is_no_fault_and_stays(muddled):
    take = capture.read_capture(muddled.path)
    found = loop.detect_on_trajectories(take, None, None, lambda fault: fault.kind not in ("swap", "fragment", "spike"))
    assert not {fault.kind for fault in found.faults.items} & {"swap", "fragment", "spike"}
    np.testing.assert_array_equal(found.take.markers, take.markers)


def test_every_sample_of_the_file_is_still_in_it_once(muddled, looked):
    take = capture.read_capture(muddled.path)
    sources = looked.take.source_points[looked.take.visible].tolist()
    frames = np.broadcast_to(np.arange(take.frame_count)[:, None], take.visible.shape)[looked.take.visible].tolist()
    assert len(set(zip(frames, sources, strict=True))) == len(sources)
    assert set(sources) <= set(columns(take).values())


# by hand


TAKE = Take(np.random.default_rng(0).normal(size=(100, 3, 3)), tuple("ABC"), 100.0)


def on_body(columns, places) -> BodyFit:
    """-> a body of which only its markers' places are asked"""
    worn = type("Worn", (), {"marker_offsets": np.array(places, float)})()
    return BodyFit(worn, worn, None, np.array(columns), np.zeros(0), np.zeros(0))  # pyright: ignore


@pytest.mark.parametrize(("apart", "dismissed"), [(0.0239, True), (0.0241, False)])
def test_a_move_stands_where_the_body_bears_out_most_of_it(apart, dismissed):
    move = MarkerShift("moved", 1, 50, 99, 0.04, "", settled_frame=50)
    found = DetectionState(TAKE, (), Faults((move,)))
    parts = repair.split_moved_markers(TAKE, [move])
    body = on_body([0, 1, 2, 3], [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, apart, 0]])
    assert loop.find_unconfirmed_shifts(found, parts, body) == ([move] if dismissed else [])


def test_a_move_to_where_it_is_hardly_seen_is_dismissed_and_that_of_no_marker_of_the_body_is_not():
    early, foreign = (
        MarkerShift("moved", 1, 90, 99, 0.04, "", settled_frame=90),
        MarkerShift("moved", 2, 50, 99, 0.04, "", settled_frame=50),
    )
    parts = repair.split_moved_markers(TAKE, [early, foreign])  # 0.1 s after the first
    body = on_body([0, 1], [[0, 0, 0], [0, 0, 0]])
    assert loop.find_unconfirmed_shifts(DetectionState(TAKE, (), Faults((early, foreign))), parts, body) == [early]


def seen_off(monkeypatch, *faults):
    monkeypatch.setattr(loop, "detect_epoch_body_faults", lambda *_: list(faults))
    monkeypatch.setattr(loop, "find_unconfirmed_shifts", lambda *_: [])
    monkeypatch.setattr(loop, "detect_remaining_faults", lambda take, worn_set, stands: Faults((Fault("gap", 2, 0, 3, 0.1, "anew"),)))


def again(found, stands=anything):
    return loop.detect_on_body(
        found, repair.split_moved_markers(TAKE, []), on_body([], []), marker_sets.load_marker_set("cmu41"), stands
    )


SPIKE, GHOST = Fault("spike", 0, 10, 10, 0.1, ""), Fault("ghost", 1, 30, 60, 0.1, "")
SWAP = Fault("swap", 0, 20, 40, 0.1, "", 1.0, (1,))


def test_nothing_new_is_none(monkeypatch):
    seen_off(monkeypatch, SPIKE)
    assert again(DetectionState(TAKE, (), Faults((SPIKE,)))) is None
    assert again(DetectionState(TAKE, (), Faults()), lambda fault: False) is None


def test_what_the_body_shows_is_added_to_what_was_known(monkeypatch):
    seen_off(monkeypatch, GHOST)
    more = again(DetectionState(TAKE, (), Faults((SPIKE,))))
    assert more is not None
    assert (more.take, more.label_faults, more.sample_faults.items) == (TAKE, (), (SPIKE, GHOST))


def test_a_swap_is_undone_and_the_samples_are_judged_anew_without_what_it_explains(monkeypatch):
    seen_off(monkeypatch, SWAP, GHOST, SPIKE)
    more = again(DetectionState(TAKE, (), Faults()))
    assert more is not None
    np.testing.assert_array_equal(more.take.markers, TAKE.exchange_labels((0, 1), 20, 40).markers)
    assert more.label_faults == (SWAP,)
    assert {fault.kind for fault in more.sample_faults.items} == {"gap", "spike"}


def test_what_the_body_showed_before_is_not_forgotten_when_a_swap_is_found(monkeypatch):
    seen_off(monkeypatch, GHOST, SPIKE)
    once = again(DetectionState(TAKE, (), Faults()))
    assert once is not None
    seen_off(monkeypatch, replace(SWAP, first=15, last=25))
    twice = again(once)
    assert twice is not None
    assert {fault.kind for fault in twice.sample_faults.items} == {"gap", "ghost", "spike"}


def test_a_move_that_was_dismissed_stays_so(monkeypatch):
    move = MarkerShift("moved", 2, 60, 99, 0.04, "", settled_frame=60)
    seen_off(monkeypatch)
    monkeypatch.setattr(loop, "find_unconfirmed_shifts", lambda found, *_: [f for f in found.sample_faults.items if f.kind == "moved"])
    more = again(DetectionState(TAKE, (), Faults((SPIKE, move))))
    assert more is not None
    assert (more.sample_faults.items, more.rejected_shifts) == ((SPIKE,), (move,))
    assert again(more) is None


def test_pieces_that_nothing_came_of_are_told_of_once(muddled):
    take = capture.read_capture(muddled.path)
    found = loop.detect_on_trajectories(take, None, None, anything)
    told = [(f.donor, f.first) for f in found.label_faults if isinstance(f, Fragment)]
    assert len(told) == len(set(told)) == 2


def test_what_shows_only_beside_what_is_replaced_is_found_as_well(monkeypatch):
    """Once the burst is not asked any more the spike beside it shows; then nothing more."""
    burst, spike, gap = Fault("jitter", 0, 10, 19, 0.1, ""), Fault("spike", 0, 20, 20, 0.1, ""), Fault("gap", 1, 0, 3, 0.1, "")
    asked = []

    def found(take, worn_set):
        asked.append(take.measured)
        worse = [burst] if take.measured[10, 0] else [spike] if take.measured[20, 0] else []
        return Faults((gap, *worse))

    monkeypatch.setattr(loop, "detect_sample_faults", found)
    assert loop.detect_remaining_faults(TAKE, None, anything).items == (burst, spike, gap)
    assert len(asked) == 3
    np.testing.assert_array_equal(np.flatnonzero(~asked[-1].all(1)), np.arange(10, 21))
    assert TAKE.computed is None

"""The detection loop: which labels are corrected and in which order, and what the solved body adds and removes."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.detect import loop
from mocapfix.io import capture
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault, FaultReview, Faults, Fragment, MarkerShift
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.subject.library import build_subject_marker_set, load_marker_set
from tests.faulty_take import map_labels_to_points

NAN = np.nan
OPTIONS = CleanOptions()
NO_REVIEW = FaultReview()


@pytest.fixture(scope="module")
def detection(faulty) -> Detected:
    marker_set = build_subject_marker_set(faulty.subject)
    return loop.detect_on_trajectories(capture.read_take(faulty.path), marker_set, faulty.subject, NO_REVIEW, OPTIONS)


def test_labels_are_corrected_before_samples_are_judged(faulty, detection):
    labels = detection.take.labels
    assert [(f.kind, labels[f.marker], f.first, f.last) for f in detection.label_faults] == [
        ("fragment", "RFHD", 100, 159),
        ("fragment", "RHEE", 150, 199),
        ("swap", "LWRA", 220, 289),
    ]
    assert {(f.kind, labels[f.marker], f.first, f.last) for f in detection.sample_faults.items} == {
        ("spike", "STRN", 20, 20),
        ("gap", "RELB", 40, 59),
        ("spike", "LWRB", 250, 250),  # in the file it is under LWRA
    }
    error_m = np.linalg.norm(detection.take.markers[:, :-1] - faulty.truth, axis=-1)
    assert np.nanmax(np.where(detection.inlier_mask[:, :-1], error_m, NAN)) < 1e-6


def test_fragment_donors_are_not_judged(detection):
    assert [detection.take.labels[m] for m in detection.donor_markers] == ["RFHD-1"]
    assert not any(fault.marker in detection.donor_markers for fault in detection.sample_faults.items)


def test_rejected_faults_change_nothing(faulty):
    take = capture.read_take(faulty.path)
    review = FaultReview(accepts=lambda fault: fault.kind not in ("swap", "fragment", "spike"))
    found = loop.detect_on_trajectories(take, None, None, review, OPTIONS)
    assert not {fault.kind for fault in found.faults.items} & {"swap", "fragment", "spike"}
    np.testing.assert_array_equal(found.take.markers, take.markers)


def test_every_sample_of_the_file_is_kept_once(faulty, detection):
    take = capture.read_take(faulty.path)
    sources = detection.take.source_points[detection.take.visible].tolist()
    frame_indices = np.broadcast_to(np.arange(take.frame_count)[:, None], take.visible.shape)
    frames = frame_indices[detection.take.visible].tolist()
    assert len(set(zip(frames, sources, strict=True))) == len(sources)
    assert set(sources) <= set(map_labels_to_points(take).values())


def test_unused_fragments_are_reported_once(faulty):
    found = loop.detect_on_trajectories(capture.read_take(faulty.path), None, None, NO_REVIEW, OPTIONS)
    fragments = [(f.donor, f.first) for f in found.label_faults if isinstance(f, Fragment)]
    assert len(fragments) == len(set(fragments)) == 2


# on a take and a body made by hand


TAKE = Take(np.random.default_rng(0).normal(size=(100, 3, 3)), tuple("ABC"), 100.0)


def build_body(marker_columns, marker_offsets) -> BodyFit:
    """Build a body of which only the marker offsets are used."""
    subject = object.__new__(Subject)
    object.__setattr__(subject, "marker_offsets", np.array(marker_offsets, float))
    motion = object.__new__(Motion)
    columns = np.array(marker_columns, int)
    return BodyFit(subject, subject, columns, TAKE, motion, np.zeros((0, 0, 3)), np.zeros((0, len(columns), 3)), None)


@pytest.mark.parametrize(("change_m", "is_rejected"), [(0.0239, True), (0.0241, False)])
def test_shift_is_confirmed_by_the_body(change_m, is_rejected):
    shift = MarkerShift("moved", 1, 50, 99, 0.04, "", settled_frame=50)
    body = build_body([0, 1, 2, 3], [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, change_m, 0]])
    found = loop.find_unconfirmed_shifts(Detected(TAKE, (), Faults((shift,))), body)
    assert found == ([shift] if is_rejected else [])


def test_a_marker_that_is_put_back_was_away():
    """Each shift is compared with the place after it, not with that at the end of the take, which is the first one again."""
    knocked = MarkerShift("moved", 1, 30, 99, 0.04, "", settled_frame=30)
    replaced = MarkerShift("moved", 1, 70, 99, 0.04, "", settled_frame=70)
    detection = Detected(replace(TAKE, rate=50.0), (), Faults((knocked, replaced)))
    columns = [int(detection.epochs.find_column(1, frame)) for frame in (0, 50, 90)]
    offsets = dict(zip(columns, ([0, 0, 0], [0, 0.04, 0], [0, 0, 0]), strict=True))
    body = build_body([0, *offsets], [[0, 0, 0], *offsets.values()])
    assert loop.find_unconfirmed_shifts(detection, body) == []


def test_shift_to_a_rarely_visible_position_is_unconfirmed():
    """A shift of a marker that is not on the body is not checked."""
    late = MarkerShift("moved", 1, 90, 99, 0.04, "", settled_frame=90)
    off_body = MarkerShift("moved", 2, 50, 99, 0.04, "", settled_frame=50)
    body = build_body([0, 1], [[0, 0, 0], [0, 0, 0]])
    detection = Detected(TAKE, (), Faults((late, off_body)))
    assert loop.find_unconfirmed_shifts(detection, body) == [late]


def test_what_goes_on_for_a_second_beside_a_burst_of_jitter_is_no_jitter(monkeypatch):
    body, take = build_body([0, 1, 2], np.zeros((3, 3))), replace(TAKE, rate=30.0)
    short, long, other = (Fault("ghost", k, 40, last, 0.3, "") for k, last in ((1, 79), (1, 80), (2, 79)))  # 30, 31, 40 samples
    monkeypatch.setattr(loop, "detect_body_faults", lambda *_, **__: [short, long, other])
    jitter = Fault("jitter", 1, 50, 59, 0.01, "")
    assert loop.detect_epoch_faults(Detected(take, (), Faults((jitter,))), body, OPTIONS.detect) == [long, other]


def mock_detectors(monkeypatch, *body_faults):
    monkeypatch.setattr(loop, "detect_epoch_faults", lambda *_: list(body_faults))
    monkeypatch.setattr(loop, "find_unconfirmed_shifts", lambda *_: [])
    monkeypatch.setattr(loop, "detect_remaining_faults", lambda *_: Faults((Fault("gap", 2, 0, 3, 0.1, "new"),)))


def detect_again(detection, review=NO_REVIEW) -> Detected | None:
    """Run one round of detection on the body; None if it finds nothing."""
    body, marker_set = build_body([], np.zeros((0, 3))), load_marker_set("cmu41")
    found = loop.detect_on_body(detection, body, marker_set, review, OPTIONS.detect)
    return None if found is detection else found


SPIKE, GHOST = Fault("spike", 0, 10, 10, 0.1, ""), Fault("ghost", 1, 30, 60, 0.1, "")
SWAP = Fault("swap", 0, 20, 40, 0.1, "", 1.0, (1,))


def test_state_is_unchanged_without_new_faults(monkeypatch):
    mock_detectors(monkeypatch, SPIKE)
    assert detect_again(Detected(TAKE, (), Faults((SPIKE,)))) is None
    assert detect_again(Detected(TAKE), FaultReview(accepts=lambda fault: False)) is None


def test_body_faults_are_added(monkeypatch):
    mock_detectors(monkeypatch, GHOST)
    found = detect_again(Detected(TAKE, (), Faults((SPIKE,))))
    assert found is not None
    assert (found.take, found.label_faults, found.sample_faults.items) == (TAKE, (), (SPIKE, GHOST))


def test_swap_is_undone_and_samples_are_judged_again_without_what_it_explains(monkeypatch):
    mock_detectors(monkeypatch, SWAP, GHOST, SPIKE)
    found = detect_again(Detected(TAKE))
    assert found is not None
    np.testing.assert_array_equal(found.take.markers, TAKE.exchange_labels((0, 1), 20, 40).markers)
    assert found.label_faults == (SWAP,)
    assert {fault.kind for fault in found.sample_faults.items} == {"gap", "spike"}


def test_earlier_body_faults_are_kept_when_a_swap_is_found(monkeypatch):
    mock_detectors(monkeypatch, GHOST, SPIKE)
    once = detect_again(Detected(TAKE))
    assert once is not None
    mock_detectors(monkeypatch, replace(SWAP, first=15, last=25))
    twice = detect_again(once)
    assert twice is not None
    assert {fault.kind for fault in twice.sample_faults.items} == {"gap", "ghost", "spike"}


def test_rejected_shift_stays_rejected(monkeypatch):
    shift = MarkerShift("moved", 2, 60, 99, 0.04, "", settled_frame=60)
    mock_detectors(monkeypatch)
    monkeypatch.setattr(
        loop, "find_unconfirmed_shifts", lambda found, *_: [f for f in found.sample_faults.items if f.kind == "moved"]
    )
    found = detect_again(Detected(TAKE, (), Faults((SPIKE, shift))))
    assert found is not None
    assert (found.sample_faults.items, found.unconfirmed_shifts) == ((SPIKE,), (shift,))
    assert detect_again(found) is None


def test_faults_hidden_by_replaced_samples_are_found(monkeypatch):
    """Without the samples of the burst the spike next to it shows; then nothing more."""
    burst, spike, gap = Fault("jitter", 0, 10, 19, 0.1, ""), Fault("spike", 0, 20, 20, 0.1, ""), Fault("gap", 1, 0, 3, 0.1, "")
    measured = []

    def detect(take, *_):
        measured.append(take.measured)
        replaced = [burst] if take.measured[10, 0] else [spike] if take.measured[20, 0] else []
        return Faults((gap, *replaced))

    monkeypatch.setattr(loop, "detect_sample_faults", detect)
    assert loop.detect_remaining_faults(TAKE, None, NO_REVIEW, OPTIONS.detect).items == (burst, spike, gap)
    assert len(measured) == 3
    np.testing.assert_array_equal(np.flatnonzero(~measured[-1].all(1)), np.arange(10, 21))
    assert TAKE.computed is None

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.io import capture
from mocapfix.labels import label_swaps
from mocapfix.labels.label_swaps import find_permutation_cycles, select_fullest_frames
from mocapfix.model.faults import MIN_LABEL_CONFIDENCE
from mocapfix.model.take import Take
from mocapfix.subject.library import build_subject_marker_set, choose_marker_set
from mocapfix.synthetic import compose_take
from tests.captures import CAPTURES, needs_captures
from tests.detect.people import CMU41, columns, compose_person, mirrored, relabelled, without

PAIRED = tuple(label[1:] for label in CMU41.labels if label[0] == "L" and f"R{label[1:]}" in CMU41.labels)


def undone(take, found):
    for fault in found:
        if fault.confidence >= MIN_LABEL_CONFIDENCE:
            take = take.exchange_labels(fault.markers, fault.first, fault.last)
    return take


@pytest.mark.parametrize("seed", range(4))
def test_correct_labels_of_subjects_off_the_average(seed):
    assert label_swaps.detect_mislabelled(compose_person(seed), CMU41) == []


@pytest.mark.parametrize(
    "cycle",
    [("LTOE", "LMT5"), ("RWRA", "RWRB"), ("LKNE", "LANK"), ("LWRA", "LFIN"), ("RANK", "RHEE"), ("LFHD", "RFHD"), ("LFHD", "LBHD"),
     ("LBWT", "RBWT"), ("C7", "RBAC"), ("LFHD", "RTOE"), ("LTOE", "LMT5", "LHEE"), ("LMT5", "LTOE", "LHEE")],
)  # fmt: skip
def test_exchange_is_found_in_the_right_direction(cycle):
    sound = compose_person()
    take = relabelled(sound, *cycle)
    (fault,) = label_swaps.detect_mislabelled(take, CMU41)
    assert set(fault.markers) == set(columns(take, *cycle))
    assert (fault.kind, fault.first, fault.last) == ("mislabelled", 0, take.frame_count - 1)
    np.testing.assert_array_equal(undone(take, [fault]).markers, sound.markers)


@pytest.mark.parametrize(
    "labels", [("FHD", "BHD"), ("UPA", "ELB", "FRM", "WRA", "WRB", "FIN"), ("HEE", "TOE", "MT5"), ("FWT", "BWT"), PAIRED]
)
def test_mirrored_parts_are_found_pair_by_pair_with_one_reason(labels):
    sound = compose_person(1)
    take = mirrored(sound, *labels)
    found = label_swaps.detect_mislabelled(take, CMU41)
    assert sorted(fault.markers for fault in found) == sorted(columns(take, f"L{label}", f"R{label}") for label in labels)
    np.testing.assert_array_equal(undone(take, found).markers, sound.markers)
    (reason,) = {fault.reason for fault in found}
    assert reason.startswith("Left and right are exchanged over the whole take (")
    assert f"L{labels[0]}" in reason


def test_exchange_on_both_sides_is_a_naming_convention():
    sound = compose_person(1)
    convention = relabelled(relabelled(sound, "LTOE", "LMT5"), "RTOE", "RMT5")
    assert label_swaps.detect_mislabelled(convention, CMU41) == []
    (fault,) = label_swaps.detect_mislabelled(relabelled(convention, "LWRA", "LFIN"), CMU41)
    assert set(fault.markers) == set(columns(sound, "LWRA", "LFIN"))


def test_absent_markers_are_not_exchanged():
    take = mirrored(compose_person(1), "UPA", "ELB", "FRM", "WRA", "WRB", "FIN")
    kept = [m for m, label in enumerate(take.labels) if label != "RFIN"]
    take = Take(take.markers[:, kept], tuple(take.labels[m] for m in kept), take.rate)
    found = label_swaps.detect_mislabelled(take, CMU41)
    assert {fault.markers for fault in found} == {columns(take, f"L{b}", f"R{b}") for b in ("UPA", "ELB", "FRM", "WRA", "WRB")}


def test_several_exchanges_are_found_despite_gaps():
    take = relabelled(relabelled(compose_person(2), "LTOE", "LMT5"), "RWRA", "RWRB", "RFIN")
    take = without(without(take, "RWRA", "LTOE", "C7", first=0, last=40), "LANK", "LHEE", first=50)
    found = label_swaps.detect_mislabelled(take, CMU41)
    assert {frozenset(fault.markers) for fault in found} == {
        frozenset(columns(take, "LTOE", "LMT5")),
        frozenset(columns(take, "RWRA", "RWRB", "RFIN")),
    }


def test_labels_wrong_for_most_of_the_take_are_mislabelled():
    sound = compose_person()
    markers = relabelled(sound, "LKNE", "LANK").markers.copy()
    markers[70:] = sound.markers[70:]
    (fault,) = label_swaps.detect_mislabelled(sound.replace_markers(markers), CMU41)
    assert (fault.first, fault.last) == (0, sound.frame_count - 1)
    markers[25:] = sound.markers[25:]
    assert label_swaps.detect_mislabelled(sound.replace_markers(markers), CMU41) == []


def test_reason_names_labels_and_distances():
    take = relabelled(compose_person(), "LKNE", "LANK")
    (fault,) = label_swaps.detect_mislabelled(take, CMU41)
    start = f"LKNE and LANK have exchanged their labels over the whole take: their samples lie {fault.severity * 1e3:.0f} mm from"
    assert fault.reason.startswith(f"{start} the marker set's positions on the body, and ")
    assert fault.severity > 0.15


@pytest.mark.parametrize("scale", [0.6, 1.2])
def test_small_and_large_subjects(scale):
    take = compose_person(3)
    take = take.replace_markers(take.markers * scale)
    assert label_swaps.detect_mislabelled(take, CMU41) == []
    assert len(label_swaps.detect_mislabelled(relabelled(take, "LTOE", "LMT5"), CMU41)) == 1


def test_known_subject_replaces_the_average_body():
    truth = compose_take(3, 2.0, 30.0, asymmetric=True)
    small = replace(truth.subject.skeleton, offsets=truth.subject.skeleton.offsets * 0.6)
    subject = replace(truth.subject, skeleton=small, marker_offsets=truth.subject.marker_offsets * 0.6)
    child = Take(truth.marker_positions * 0.6, truth.labels, 30.0)
    marker_set = build_subject_marker_set(subject)
    assert label_swaps.detect_mislabelled(child, marker_set, subject) == []
    (fault,) = label_swaps.detect_mislabelled(relabelled(child, "LBWT", "RBWT"), marker_set, subject)
    assert fault.markers == columns(child, "LBWT", "RBWT")
    assert "mm from the marker set's positions" in fault.reason


def test_other_markers_with_the_same_labels_are_not_judged():
    take = compose_person()
    elsewhere = np.random.default_rng(0).normal(0, 0.4, (1, 41, 3)) + 0.001 * take.markers[:8]
    assert label_swaps.detect_mislabelled(take.replace_markers(elsewhere), CMU41) == []


def test_rarely_visible_markers_are_not_judged():
    take = relabelled(compose_person(), "LTOE", "LMT5")
    assert label_swaps.detect_mislabelled(without(take, "LTOE", "LMT5", first=5), CMU41) == []
    assert label_swaps.detect_mislabelled(take.replace_markers(np.full(take.markers.shape, np.nan)), CMU41) == []
    assert label_swaps.detect_mislabelled(take.replace_markers(take.markers[:0]), CMU41) == []


def test_fullest_frames_are_selected():
    markers = np.zeros((100, 20, 3)) + np.arange(100.0)[:, None, None]
    markers[:50, :10] = np.nan
    some = select_fullest_frames(markers)
    assert some.shape == (16, 20, 3)
    assert (some[0, 0, 0], some[-1, 0, 0]) == (50, 99)
    assert select_fullest_frames(markers[:, :11]).shape == (0, 11, 3)


def test_permutation_cycles():
    assert find_permutation_cycles(np.array([0, 1, 2])) == []
    assert find_permutation_cycles(np.array([2, 1, 4, 3, 0])) == [(0, 2, 4)]
    assert find_permutation_cycles(np.array([1, 0, 3, 2])) == [(0, 1), (2, 3)]


@needs_captures
@pytest.mark.parametrize(
    "name", ["cmu/05_13", "cmu/85_02", "c3d/tennis_serve_motive", "c3d/FunctionalWalk", "c3d/Movement_trial"]
)
def test_captures_have_correct_labels(name):
    take = capture.read_take(CAPTURES / f"{name}.c3d")
    marker_set = choose_marker_set(take.labels).marker_set
    assert marker_set is not None
    assert label_swaps.detect_mislabelled(take, marker_set) == []

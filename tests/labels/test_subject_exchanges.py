"""Labels exchanged between two people: of a marker, of a limb and of the whole person, for a while and to the end of the take."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.lab.label_recovery import place_two_people
from mocapfix.labels import multi_subject
from mocapfix.labels.multi_subject import (
    SubjectSamples,
    assign_persons,
    is_exchange_possible,
    sum_evidence,
)
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take

RATE = 60.0
ARM = ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")
FOOT = ("RANK", "RHEE", "RTOE", "RMT5")


@pytest.fixture(scope="module", params=[False, True], ids=["beside", "crossing"])
def two_people(request: pytest.FixtureRequest) -> Take:
    """The second person does at another time what the first one does."""
    one = compose_take(5, 12.0, RATE, asymmetric=True)
    other = compose_take(6, 12.0, RATE, asymmetric=True)
    second = other.damaged_positions[60:]
    people = place_two_people(
        one.damaged_positions[:-60], second, (one.labels, other.labels), 0.7 if request.param else 1.0, crossing=request.param
    )
    return Take(people.markers, people.labels, RATE)


def find_pairs(take: Take, labels: tuple[str, ...]) -> list[tuple[int, int]]:
    return [(take.labels.index(f"P1:{label}"), take.labels.index(f"P2:{label}")) for label in labels]


def measure_subjects(take: Take, *names: str) -> list[SubjectSamples]:
    subjects = np.array(take.marker_subjects, object)
    return [SubjectSamples.measure(take.extract_markers(np.flatnonzero(subjects == name), name)) for name in names]


def detect_subject_exchanges(take: Take, first: str, second: str) -> list[Fault]:
    one, two = measure_subjects(take, first, second)
    faults = multi_subject.detect_subject_exchanges((one, two))
    assert not faults or is_exchange_possible(one, two)
    return faults


def test_nothing_is_found_where_nothing_was_exchanged(two_people: Take) -> None:
    assert not detect_subject_exchanges(two_people, "P1", "P2")


@pytest.mark.parametrize(("first", "last"), [(200, 206), (300, 400), (450, 659)])
@pytest.mark.parametrize("labels", [("RFWT",), ("LWRA",), ARM, FOOT, None], ids=["hip", "wrist", "arm", "foot", "person"])
def test_exchanges_are_found_and_undone(two_people: Take, labels: tuple[str, ...] | None, first: int, last: int) -> None:
    take = two_people
    pairs = find_pairs(take, labels or tuple(dict.fromkeys(take.bare_labels)))
    exchanged = take.exchange_labels_in_turn([(pair, first, last) for pair in pairs])
    faults = detect_subject_exchanges(exchanged, "P1", "P2")
    assert all(fault.kind == "swap" and fault.markers in pairs and fault.confidence > 0.9 for fault in faults)
    corrected = exchanged.exchange_labels_in_turn([(fault.markers, fault.first, fault.last) for fault in faults])
    visible = take.visible[first : last + 1, pairs]
    is_right = (corrected.markers == take.markers).all(-1)
    assert is_right[first : last + 1, pairs][visible].mean() > 0.95
    assert is_right[take.visible].mean() > 0.99


def test_an_exchange_that_begins_and_ends_in_a_gap_is_found(two_people: Take) -> None:
    pairs = find_pairs(two_people, FOOT)
    exchanged = two_people.exchange_labels_in_turn([(pair, 250, 420) for pair in pairs])
    hidden = np.ones_like(exchanged.visible)
    for m in np.ravel(pairs):
        hidden[[*range(240, 262), *range(410, 430)], m] = False
    faults = detect_subject_exchanges(exchanged.masked(hidden), "P1", "P2")
    assert {fault.markers for fault in faults} == set(pairs)
    assert all(240 <= fault.first <= 262 and 408 <= fault.last <= 430 for fault in faults)


def test_only_subjects_that_are_near_or_to_whom_labels_leap_are_searched(two_people: Take) -> None:
    markers = two_people.markers.copy()
    markers[:, len(markers[0]) // 2 :, 0] += 5.0
    apart = replace(two_people, markers=markers)
    spike = markers.copy()
    spike[300, two_people.labels.index("P1:LFHD"), 0] += 4.0  # nearer to the other head, but not where that was
    assert is_exchange_possible(*measure_subjects(two_people, "P1", "P2"))
    for take in (apart, replace(apart, markers=spike)):
        assert not is_exchange_possible(*measure_subjects(take, "P1", "P2"))
    for first, last in ((0, len(markers) - 1), (200, 203)):
        pairs = find_pairs(apart, ARM)
        exchanged = apart.exchange_labels_in_turn([(pair, first, last) for pair in pairs])
        faults = detect_subject_exchanges(exchanged, "P1", "P2")
        assert {fault.markers for fault in faults} == set(pairs)


def test_labels_that_one_subject_lacks_are_not_compared(two_people: Take) -> None:
    kept = np.array([not label.startswith("P2:") or label == "P2:LFHD" for label in two_people.labels])
    part = two_people.extract_markers(np.flatnonzero(kept), "")
    assert not detect_subject_exchanges(part, "P1", "P2")
    assert not detect_subject_exchanges(part, "P1", "P3")


def test_tracklets_are_assigned_by_their_relations_and_groups_by_their_labels() -> None:
    one, two = np.array([[0, 1], [1, 2], [0, 2], [3, 4]]).T
    evidence = sum_evidence(one, two, np.array([5.0, -4.0, -1.0, 3.0]), 5)
    label_s = np.array([2.0, -1.0, -2.0, 0.1, -4.0])
    person, support = assign_persons(evidence, label_s)
    assert person.tolist() == [0, 0, 1, 1, 1]
    assert support[1] == pytest.approx(5 + 4 - 0.02)
    assert support[3] == pytest.approx(3 - 0.002)


def test_one_wrong_strong_relation_does_not_exchange_a_group() -> None:
    one, two = np.array([[0, 1], [2, 3], [1, 2], [0, 2], [0, 3], [1, 3]]).T
    evidence = sum_evidence(one, two, np.array([9.0, 9.0, -6.0, 4.0, 4.0, 4.0]), 4)
    assert assign_persons(evidence, np.ones(4))[0].tolist() == [0, 0, 0, 0]


def test_evidence_of_one_pair_is_added_up() -> None:
    one, two = np.array([4, 4, -1, 2, 7]), np.array([2, 2, 3, 4, 7])
    total = sum_evidence(one, two, np.array([1.0, 2.0, 5.0, 40.0, 1.0]), 8).toarray()
    assert total[2, 4] == total[4, 2] == total.sum() / 2 == 43.0
    assert not sum_evidence(one, two, np.full(5, np.nan), 8).nnz

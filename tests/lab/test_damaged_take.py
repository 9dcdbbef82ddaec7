"""Places for faults: free, inside the take, at a distance from each other."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.lab.fault_detection import MIN_FAULT_DISTANCE_S, DamagedTake, FaultPlace
from mocapfix.model.faults import Fault
from mocapfix.synthetic import compose_take


@pytest.fixture(scope="module")
def sound():
    truth = compose_take(seed=1, seconds=3.0)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))


@pytest.fixture
def damaged_take(sound):
    return DamagedTake(sound, np.random.default_rng(0))


def test_durations_are_log_uniform(damaged_take):
    drawn = np.array([damaged_take.draw_log_uniform(0.1, 10.0) for _ in range(4000)])
    assert (drawn.min(), drawn.max()) == (pytest.approx(0.1, rel=0.05), pytest.approx(10.0, rel=0.05))
    assert (drawn < 1.0).mean() == pytest.approx(0.5, abs=0.03)


def test_displacements_have_random_directions(damaged_take):
    displacements = np.array([damaged_take.draw_displacement(1.0, 1.0) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.norm(displacements, axis=1), 1.0)
    np.testing.assert_allclose(displacements.mean(0), 0.0, atol=0.05)


def test_places_are_inside_the_take_and_at_a_distance_from_faults(damaged_take):
    margin, places = round(MIN_FAULT_DISTANCE_S * damaged_take.rate_hz), []
    for _ in range(10):
        place = damaged_take.draw_place((0.1, 0.3), marker_count=2)
        assert place is not None
        assert place.first >= 2
        assert place.last <= damaged_take.frame_count - 3
        assert 0.1 * damaged_take.rate_hz <= place.frame_count <= 0.3 * damaged_take.rate_hz
        assert place.markers[1] in damaged_take.neighbours[place.markers[0], :3]
        for other in places:
            overlaps = place.first - margin <= other.last and other.first <= place.last + margin
            assert not (overlaps and set(place.markers) & set(other.markers))
        damaged_take.record_fault(
            Fault("swap", place.markers[0], place.first, place.last, 0.1, "", other_markers=place.markers[1:])
        )
        places.append(place)


def test_take_full_of_faults_has_no_place(damaged_take):
    damaged_take.record_fault(
        Fault("swap", 0, 0, damaged_take.frame_count - 1, 0.1, "", other_markers=tuple(range(1, damaged_take.marker_count)))
    )
    assert damaged_take.draw_place((0.1, 0.2)) is None
    assert not damaged_take.is_free(FaultPlace((3,), 5, 6))


def test_no_place_for_too_long_faults_or_markers_at_rest(damaged_take):
    assert damaged_take.draw_place((10.0, 20.0)) is None
    assert damaged_take.draw_place((0.1, 0.2), min_motion_m=100.0) is None


def test_neighbours_of_a_wrist_are_on_hand_and_forearm(damaged_take):
    labels = np.array(damaged_take.labels)
    near = set(labels[damaged_take.neighbours[list(labels).index("LWRA"), :3]])
    assert near <= {"LWRB", "LFIN", "LFRM"}


def test_hidden_samples_are_missing_and_recorded_as_secondary(damaged_take):
    damaged_take.hide_samples(4, 10, 19)
    assert damaged_take.damaged_truth.missing_mask[:, 4].sum() == 10
    assert damaged_take.damaged_truth.missing_mask.sum() == 10
    assert [(fault.kind, fault.marker, fault.first, fault.last) for fault in damaged_take.secondary_faults] == [
        ("gap", 4, 10, 19)
    ]
    assert damaged_take.injected_faults == []
    assert not np.isnan(damaged_take.true_markers).any()


def test_added_trajectory_comes_after_the_markers(damaged_take):
    path = np.full((damaged_take.frame_count, 3), np.nan)
    path[5:9] = 1.0
    damaged_take.add_trajectory("*1", path)
    assert damaged_take.damaged_truth.labels == (*damaged_take.sound_truth.labels, "*1")
    np.testing.assert_array_equal(damaged_take.damaged_truth.damaged_positions[:, -1], path)
    assert damaged_take.true_markers.shape[1] == damaged_take.marker_count

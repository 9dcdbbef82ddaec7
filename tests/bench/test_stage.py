"""Places for faults: free ones, inside the take, apart from one another."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench.damaged_take import MIN_FAULT_DISTANCE_S, DamagedTake, FaultPlace
from mocapfix.faults import Fault


@pytest.fixture(scope="module")
def sound():
    truth = synthetic.compose_take(seed=1, seconds=3.0)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))


@pytest.fixture
def stage(sound):
    return DamagedTake(sound, np.random.default_rng(0))


def test_lengths_are_spread_evenly_over_their_logarithm(stage):
    drawn = np.array([stage.spread(0.1, 10.0) for _ in range(4000)])
    assert (drawn.min(), drawn.max()) == (pytest.approx(0.1, rel=0.05), pytest.approx(10.0, rel=0.05))
    assert (drawn < 1.0).mean() == pytest.approx(0.5, abs=0.03)


def test_steps_go_every_way(stage):
    ways = np.array([stage.draw_displacement(1.0, 1.0) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0)
    np.testing.assert_allclose(ways.mean(0), 0.0, atol=0.05)


def test_places_lie_inside_the_take_and_apart_from_what_happened(stage):
    margin, places = round(MIN_FAULT_DISTANCE_S * stage.rate_hz), []
    for _ in range(10):
        place = stage.place((0.1, 0.3), marker_count=2)
        assert place is not None
        assert place.first >= 2
        assert place.last <= stage.frames - 3
        assert 0.1 * stage.rate_hz <= place.frame_count <= 0.3 * stage.rate_hz
        assert place.markers[1] in stage.neighbours[place.markers[0], :3]
        for other in places:
            meets = place.first - margin <= other.last and other.first <= place.last + margin
            assert not (meets and set(place.markers) & set(other.markers))
        stage.record_fault(Fault("swap", place.markers[0], place.first, place.last, 0.1, "", other_markers=place.markers[1:]))
        places.append(place)


def test_a_full_take_has_no_place_left(stage):
    stage.record_fault(Fault("swap", 0, 0, stage.frames - 1, 0.1, "", other_markers=tuple(range(1, stage.count))))
    assert stage.place((0.1, 0.2)) is None
    assert not stage.is_free(FaultPlace((3,), 5, 6))


def test_nothing_lasts_longer_than_the_take_or_happens_to_what_rests(stage):
    assert stage.place((10.0, 20.0)) is None
    assert stage.place((0.1, 0.2), min_motion_m=100.0) is None


def test_the_nearest_markers_of_a_wrist_are_on_its_hand_and_forearm(stage):
    labels = np.array(stage.labels)
    near = set(labels[stage.neighbours[list(labels).index("LWRA"), :3]])
    assert near <= {"LWRB", "LFIN", "LFRM"}


def test_what_is_hidden_is_missing_in_the_file_and_remembered_beside(stage):
    stage.hide_samples(4, 10, 19)
    assert stage.damaged_truth.missing_mask[:, 4].sum() == 10
    assert stage.damaged_truth.missing_mask.sum() == 10
    assert [(fault.kind, fault.marker, fault.first, fault.last) for fault in stage.secondary_faults] == [("gap", 4, 10, 19)]
    assert stage.injected_faults == []
    assert not np.isnan(stage.true_markers).any()


def test_one_more_trajectory_comes_behind_the_markers(stage):
    path = np.full((stage.frames, 3), np.nan)
    path[5:9] = 1.0
    stage.add("*1", path)
    assert stage.damaged_truth.labels == (*stage.sound_truth.labels, "*1")
    np.testing.assert_array_equal(stage.damaged_truth.damaged_truth[:, -1], path)
    assert stage.true_markers.shape[1] == stage.count

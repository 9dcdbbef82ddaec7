import numpy as np
import pytest

from mocapfix.labels.label_swaps import find_swap_candidates
from mocapfix.stats import marker_distances
from tests.detect.bodies import exchanged, hidden, turning


def among(take):
    return find_swap_candidates(
        marker_distances.build_trajectories(take.markers, take.rate), marker_distances.estimate_distances(take.markers)
    )


def test_sound_take_has_no_candidates():
    assert among(turning()) == []


@pytest.mark.parametrize("pair", [(0, 1), (2, 4), (1, 7)])
def test_label_that_continues_another_marker_is_a_candidate(pair):
    assert among(exchanged(turning(), pair, 100, 180)) == [pair]


def test_cycle_is_a_candidate_without_other_markers():
    found = among(exchanged(turning(), (0, 1, 2), 100, 180))
    assert (0, 1, 2) in found
    assert all({0, 1, 2} & set(group) for group in found)


def test_label_with_another_markers_distances_is_a_candidate():
    take = exchanged(turning(), (1, 3), 150, 250)
    for marker in (1, 3):
        take = hidden(hidden(take, marker, 100, 170), marker, 230, 290)  # for longer than trajectories are remembered
    assert (1, 3) in among(take)


def test_swap_to_the_end_of_the_take_is_a_candidate():
    take = exchanged(turning(), (1, 3), 300, 479)
    for marker in (1, 3):
        take = hidden(take, marker, 260, 320)
    assert (1, 3) in among(take)


def test_spike_makes_no_candidate():
    take = turning()
    markers = take.markers.copy()
    markers[200:203, 4] += [0.05, 0.3, 0.1]
    assert among(take.replace_markers(markers)) == []


def test_rarely_visible_label_is_no_candidate():
    take = exchanged(turning(), (0, 1), 100, 180)
    seldom = hidden(take, 1, 200, 479)
    assert among(seldom) == []


def test_empty_take_has_no_candidates():
    take = turning()
    assert among(take.replace_markers(np.full(take.markers.shape, np.nan))) == []

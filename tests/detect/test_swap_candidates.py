import numpy as np
import pytest

from mocapfix.detect import continuity, marker_distances
from mocapfix.detect.label_swaps import find_swap_candidates
from tests.detect.bodies import exchanged, hidden, turning


def among(take):
    return find_swap_candidates(
        continuity.build_trajectories(take.markers, take.rate), marker_distances.estimate_distances(take.markers)
    )


def test_in_a_sound_take_nobody_is_asked():
    assert among(turning()) == []


@pytest.mark.parametrize("pair", [(0, 1), (2, 4), (1, 7)])
def test_who_leaps_to_where_another_went_is_asked(pair):
    assert among(exchanged(turning(), pair, 100, 180)) == [pair]


def test_a_ring_is_asked_and_nobody_who_has_nothing_to_do_with_it():
    found = among(exchanged(turning(), (0, 1, 2), 100, 180))
    assert (0, 1, 2) in found
    assert all({0, 1, 2} & set(group) for group in found)


def test_who_keeps_anothers_distances_is_asked_though_nobody_is_seen_to_leap():
    take = exchanged(turning(), (1, 3), 150, 250)
    for marker in (1, 3):
        take = hidden(hidden(take, marker, 100, 170), marker, 230, 290)  # for longer than trajectories are remembered
    assert (1, 3) in among(take)


def test_where_both_labels_are_wrong_to_the_end_the_distances_hint():
    take = exchanged(turning(), (1, 3), 300, 479)
    for marker in (1, 3):
        take = hidden(take, marker, 260, 320)
    assert (1, 3) in among(take)


def test_a_spike_leads_nowhere():
    take = turning()
    markers = take.markers.copy()
    markers[200:203, 4] += [0.05, 0.3, 0.1]
    assert among(take.replace_markers(markers)) == []


def test_a_label_seldom_seen_is_a_fragment_and_not_asked():
    take = exchanged(turning(), (0, 1), 100, 180)
    seldom = hidden(take, 1, 200, 479)
    assert among(seldom) == []


def test_a_take_of_nothing_asks_nobody():
    take = turning()
    assert among(take.replace_markers(np.full(take.markers.shape, np.nan))) == []

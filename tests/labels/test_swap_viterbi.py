import pytest

from mocapfix.labels.label_swaps import find_exchanges
from mocapfix.stats import marker_distances
from tests.detect.bodies import exchanged, hidden, turning


def among(take, group):
    return find_exchanges(
        group, marker_distances.build_trajectories(take.markers, take.rate), marker_distances.estimate_distances(take.markers)
    )


def test_correct_labels_have_no_exchanges():
    take = turning()
    assert among(take, (0, 1)) == among(take, (0, 1, 2)) == []


@pytest.mark.parametrize(
    ("cycle", "group"), [((0, 3), (0, 3)), ((0, 3), (0, 1, 3)), ((0, 1, 2), (0, 1, 2)), ((0, 2, 1), (0, 1, 2))]
)
def test_exchange_is_found_in_its_group(cycle, group):
    (exchange,) = among(exchanged(turning(), cycle, 100, 180), group)
    assert (exchange.cycle, exchange.first, exchange.last) == (cycle, 100, 180)


def test_two_exchanges_of_a_pair_are_two():
    take = exchanged(exchanged(turning(), (0, 3), 50, 90), (0, 3), 300, 400)
    assert [(each.first, each.last) for each in among(take, (0, 3))] == [(50, 90), (300, 400)]


def test_gain_decreases_with_the_leap():
    near, far = turning(), turning()
    for take, apart in ((near, 0.02), (far, 0.2)):
        take.markers[:, 3] = take.markers[:, 0] + [apart, 0, 0]
    (little,), (much,) = (among(exchanged(take, (0, 3), 100, 180), (0, 3)) for take in (near, far))
    assert 0 < little.gain < much.gain


def test_distances_decide_which_part_is_exchanged():
    take = exchanged(turning(), (0, 3), 300, 479)
    (exchange,) = among(take, (0, 3))
    assert (exchange.first, exchange.last) == (300, 479)
    assert exchange.counter_evidence > 10  # leaps: a dozen tenths of seconds would be contradicted if the rest were wrong
    alone = exchanged(turning(segments=1, each=2), (0, 1), 300, 479)
    (blind,) = among(alone, (0, 1))
    assert abs(blind.counter_evidence) < 1e-9


def test_exchange_begins_and_ends_with_visible_samples():
    take = exchanged(turning(), (0, 3), 100, 180)
    for marker in (0, 3):
        take = hidden(hidden(take, marker, 90, 110), marker, 170, 190)
    (exchange,) = among(take, (0, 3))
    assert (exchange.first, exchange.last) == (111, 169)

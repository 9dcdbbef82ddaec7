import numpy as np
import pytest

from mocapfix.labels import label_swaps
from mocapfix.subject.library import load_marker_set
from tests.detect.people import CMU41

SHIPPED = ("cmu41", "plug-in-gait39", "frontwaist53", "production57")


@pytest.mark.parametrize("name", SHIPPED)
def test_twins_have_mirrored_labels(name):
    marker_set = load_marker_set(name)
    twin = label_swaps.find_twins(marker_set)
    for label, other in zip(marker_set.labels, twin, strict=True):
        named = {"L": "R", "R": "L"}.get(label[0], label[0]) + label[1:]
        assert marker_set.labels[other] == (named if named in marker_set.labels else label)


@pytest.mark.parametrize("name", SHIPPED)
def test_mirror_exchanges_move_twins_only(name):
    marker_set = load_marker_set(name)
    own, twin = np.arange(len(marker_set.labels)), label_swaps.find_twins(marker_set)
    for exchange in label_swaps.list_mirror_exchanges(marker_set):
        assert ((exchange == own) | (exchange == twin)).all()
        np.testing.assert_array_equal(exchange[exchange], own)


def test_mirror_exchanges_of_body_limbs_and_segments():
    groups = {
        frozenset(CMU41.labels[k] for k in np.flatnonzero(each > np.arange(41)))
        for each in label_swaps.list_mirror_exchanges(CMU41)
    }
    assert {"LFHD", "LBHD"} in groups
    assert {"LUPA", "LELB"} in groups
    assert {"LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN"} in groups
    assert {"LSHN", "LANK", "LHEE", "LTOE", "LMT5"} in groups
    assert {label for label in CMU41.labels if label[0] == "L"} in groups
    assert {"LFIN"} not in groups  # a pair like any other


def test_cycles_on_both_sides_are_removed():
    twin = np.array([3, 4, 2, 0, 1, 6, 5])
    assert label_swaps.select_one_sided_cycles([(0, 1), (3, 4)], twin) == []
    assert label_swaps.select_one_sided_cycles([(0, 1), (5, 6), (0, 3)], twin) == [(0, 1), (5, 6), (0, 3)]

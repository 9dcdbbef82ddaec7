import numpy as np
import pytest

from mocapfix.labels.fragments import join_fragments
from mocapfix.model.faults import Fault, Fragment
from mocapfix.model.take import Take

NAN = np.nan


@pytest.fixture
def take():
    """A is missing in 10-19 and computed in 5, B is complete, A-1 is visible in 8-21, *3 and *7 are complete."""
    rng = np.random.default_rng(0)
    markers, computed = rng.normal(size=(30, 3, 3)), np.zeros((30, 3), bool)
    markers[10:20, 0] = markers[:8, 2] = markers[22:, 2] = NAN
    computed[5, 0] = True
    loose = Take(rng.normal(size=(30, 2, 3)), ("*3", "*7"), 100.0, point_columns=np.array([0, 4]))
    return Take(markers, ("A", "B", "A-1"), 100.0, point_columns=np.array([1, 2, 3]), unlabelled=loose, computed=computed)


def build_fragment(marker, first, last, donor, relation):
    return Fragment("fragment", marker, first, last, 0.0, "", donor=donor, relation=relation)


def test_continuation_fills_missing_samples_only(take):
    joined = join_fragments(take, [build_fragment(0, 8, 21, 2, "continues")])
    np.testing.assert_array_equal(joined.markers[10:20, 0], take.markers[10:20, 2])
    kept = np.r_[0:10, 20:30]
    np.testing.assert_array_equal(joined.markers[kept, 0], take.markers[kept, 0])
    np.testing.assert_array_equal(joined.markers[:, 1], take.markers[:, 1])
    assert np.isnan(joined.markers[10:20, 2]).all()  # the joined samples are removed from the donor; the others stay
    np.testing.assert_array_equal(joined.markers[[8, 9, 20, 21], 2], take.markers[[8, 9, 20, 21], 2])
    np.testing.assert_array_equal(joined.source_points[:, 0], np.where((np.arange(30) >= 10) & (np.arange(30) < 20), 3, 1))
    assert joined.measured[10:20, 0].all()
    assert not joined.measured[5, 0]


def test_replacement_takes_the_markers_place(take):
    joined = join_fragments(take, [build_fragment(0, 4, 12, 3, "replaces")])
    assert take.unlabelled is not None
    assert joined.unlabelled is not None
    np.testing.assert_array_equal(joined.markers[4:13, 0], take.unlabelled.markers[4:13, 0])
    assert set(joined.source_points[4:13, 0]) == {0}  # the file's point, not the index among those that nobody named
    assert joined.measured[5, 0]
    np.testing.assert_array_equal(np.isnan(joined.unlabelled.markers[:, 0, 0]), (np.arange(30) >= 4) & (np.arange(30) < 13))
    np.testing.assert_array_equal(joined.unlabelled.markers[:, 1], take.unlabelled.markers[:, 1])
    np.testing.assert_array_equal(joined.markers[13:], take.markers[13:])


@pytest.mark.parametrize("relation", ["doubles", "other"])
def test_other_fragments_are_not_joined(take, relation):
    assert join_fragments(take, [build_fragment(0, 8, 21, 2, relation), Fault("gap", 0, 10, 19, 0.1, "")]) is take


def test_first_of_two_fragments_fills_common_frames(take):
    joined = join_fragments(take, [build_fragment(0, 10, 15, 3, "continues"), build_fragment(0, 13, 19, 4, "continues")])
    assert joined.source_points[10:20, 0].tolist() == [0] * 6 + [4] * 4


def test_input_take_is_unchanged(take):
    was = take.markers.copy()
    join_fragments(take, [build_fragment(0, 8, 21, 2, "continues"), build_fragment(0, 4, 12, 3, "replaces")])
    np.testing.assert_array_equal(take.markers, was)
    assert take.unlabelled is not None
    assert take.unlabelled.visible.all()

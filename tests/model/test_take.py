"""Takes: frame numbers, names, parts of a take, exchanged labels; and runs of a mask."""

from dataclasses import FrozenInstanceError, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model.take import Take
from mocapfix.stats.sequences import find_runs


@pytest.fixture
def take():
    markers = np.arange(24.0).reshape(4, 2, 3)
    markers[1, 0] = markers[3, 1] = np.nan
    return Take(markers, ("Jim:LFHD", "A:B:RANK"), 120.0, first_frame=100, path=Path("/captures/walk.c3d"))


def test_frame_count_and_visibility(take):
    assert take.frame_count == 4
    np.testing.assert_array_equal(take.visible, [[True, True], [False, True], [True, True], [True, False]])


def test_frame_numbers_are_those_of_the_file(take):
    assert take.get_frame_number(0) == 100
    assert take.get_frame_number(np.int64(3)) == 103
    assert type(take.get_frame_number(np.int64(3))) is int  # goes into JSON
    assert Take(take.markers, take.labels, 120.0).get_frame_number(0) == 1


def test_names_and_labels(take):
    assert take.name == "walk.c3d"
    assert Take(take.markers, take.labels, 120.0).name == "the take"
    assert take.bare_labels == ("LFHD", "RANK")
    assert Take(take.markers, ("LFHD ", " x: y"), 1.0).bare_labels == ("LFHD", "y")


def test_extracted_markers_keep_their_points_in_the_file(take):
    """The markers are points 4 and 6 of the file, and the part has the second of them."""
    visible = take.visible
    whole = replace(
        take, point_columns=np.array([4, 6]), computed=~visible, uncaptured=visible, sample_sd=np.where(visible, 0.1, np.nan)
    )
    part = whole.extract_markers(np.array([1]), "A/B")
    assert (part.labels, part.marker_subjects, part.subject_name, part.name, part.output_stem) == (
        ("A:B:RANK",), ("A:B",), "A/B", "walk.c3d (A/B)", "walk.A_B"
    )  # fmt: skip
    np.testing.assert_array_equal(part.markers, whole.markers[:, [1]])
    np.testing.assert_array_equal(part.computed, ~visible[:, [1]])
    np.testing.assert_array_equal(part.uncaptured, visible[:, [1]])
    np.testing.assert_array_equal(part.source_points, np.full((4, 1), 6))
    np.testing.assert_array_equal(whole.find_marker_indices(part), [1])
    np.testing.assert_array_equal(take.find_marker_indices(take.extract_markers(np.array([1, 0]), "both")), [1, 0])
    assert (take.output_stem, Take(take.markers, take.labels, 120.0).output_stem) == ("walk", "take")


def test_replaced_markers_do_not_change_the_take(take):
    sample_sd = np.full((4, 2), 0.001)
    other = take.replace_markers(np.zeros((4, 2, 3)), sample_sd)
    assert other.visible.all()
    assert other.sample_sd is sample_sd
    assert (other.labels, other.rate, other.first_frame, other.path) == (take.labels, take.rate, 100, take.path)
    assert take.sample_sd is None
    assert not take.visible.all()
    with pytest.raises(FrozenInstanceError):
        take.rate = 60.0


@pytest.mark.parametrize(
    ("mask", "expected"),
    [([], []), ([0], []), ([1], [(0, 0)]), ([1, 1, 0, 1], [(0, 1), (3, 3)]), ([0, 1, 1, 0], [(1, 2)])],
)
def test_runs_of_known_masks(mask, expected):
    assert find_runs(np.array(mask, bool)) == expected


@given(st.lists(st.booleans(), max_size=60))
def test_runs_cover_the_mask_and_are_not_adjacent(values):
    mask, covered = np.array(values, bool), np.zeros(len(values), bool)
    runs = find_runs(mask)
    for first, last in runs:
        assert first <= last
        covered[first : last + 1] = True
    np.testing.assert_array_equal(covered, mask)
    assert all(after[0] > before[1] + 1 for before, after in pairwise(runs))


label_cycles = st.tuples(st.permutations(range(5)), st.sampled_from([2, 3]), st.integers(0, 40), st.integers(0, 40))


@given(st.lists(label_cycles, max_size=4))
def test_a_reversed_exchange_of_labels_restores_the_take(exchanges):
    rng = np.random.default_rng(0)
    markers, sample_sd, computed = rng.normal(size=(41, 5, 3)), rng.random((41, 5)), rng.random((41, 5)) < 0.1
    markers[rng.random((41, 5)) < 0.3] = np.nan
    take = Take(markers, tuple("ABCDE"), 100.0, point_columns=np.array([3, 1, 8, 9, 0]), sample_sd=sample_sd, computed=computed)
    applied, restored = [(tuple(order[:size]), min(a, b), max(a, b)) for order, size, a, b in exchanges], take
    for cycle, first, last in applied:
        restored = restored.exchange_labels(cycle, first, last)
    for cycle, first, last in reversed(applied):
        restored = restored.exchange_labels(cycle[::-1], first, last)
    for name in ("markers", "sample_sd", "computed", "source_points"):
        np.testing.assert_array_equal(getattr(restored, name), getattr(take, name))
    for cycle, first, last in [each for each in applied if len(each[0]) == 2][:1]:
        twice = take.exchange_labels(cycle, first, last).exchange_labels(cycle, first, last)
        np.testing.assert_array_equal(twice.markers, markers)


def test_labels_are_exchanged_along_a_cycle():
    take = Take(np.arange(9.0).reshape(1, 3, 3), tuple("abc"), 1.0, point_columns=np.array([4, 5, 6]))
    exchanged = take.exchange_labels((0, 2, 1), 0, 0)  # a gets the samples of c, c those of b, b those of a
    np.testing.assert_array_equal(exchanged.markers[0], take.markers[0, [2, 0, 1]])
    np.testing.assert_array_equal(exchanged.source_points[0], [6, 4, 5])
    assert take.relabelled_points is None


def test_computed_samples_are_not_measured(take):
    computed = np.zeros((4, 2), bool)
    computed[0, 0] = computed[1, 0] = True  # the second one is missing
    np.testing.assert_array_equal(
        Take(take.markers, take.labels, 1.0, computed=computed).measured[:2], [[False, True], [False, True]]
    )


def test_indices_of_unlabelled_trajectories_follow_the_markers(take):
    unlabelled = Take(take.markers, ("*1", "*2"), 1.0)
    with_unlabelled = Take(take.markers, take.labels, 1.0, unlabelled=unlabelled)
    assert [with_unlabelled.get_label(i) for i in range(4)] == [*take.labels, "*1", "*2"]


def test_main_subject_is_that_of_most_markers(take):
    assert Take(take.markers, ("Jim:a", "prop"), 1.0, subject_names=("Jim", "Ann")).main_subject == "Jim"
    assert Take(take.markers, ("Ann:a", "Ann:b"), 1.0, subject_name="part").main_subject == "part"
    assert Take(take.markers, ("a", "b"), 1.0).main_subject == ""
    assert Take(take.markers[:, :0], (), 1.0).main_subject == ""

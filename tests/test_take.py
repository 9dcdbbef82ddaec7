from dataclasses import FrozenInstanceError, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats.runs import find_runs
from mocapfix.take import Take


@pytest.fixture
def take():
    markers = np.arange(24.0).reshape(4, 2, 3)
    markers[1, 0] = markers[3, 1] = np.nan
    return Take(markers, ("Jim:LFHD", "A:B:RANK"), 120.0, first_frame=100, path=Path("/captures/walk.c3d"))


def test_a_take_knows_what_was_seen(take):
    assert take.frame_count == 4
    np.testing.assert_array_equal(take.visible, [[True, True], [False, True], [True, True], [True, False]])


def test_frames_are_shown_by_the_files_own_numbers(take):
    assert take.get_frame_number(0) == 100
    assert take.get_frame_number(np.int64(3)) == 103
    assert type(take.get_frame_number(np.int64(3))) is int  # goes into JSON
    assert Take(take.markers, take.labels, 120.0).get_frame_number(0) == 1


def test_names_and_labels(take):
    assert take.name == "walk.c3d"
    assert Take(take.markers, take.labels, 120.0).name == "the take"
    assert take.bare_labels == ("LFHD", "RANK")
    assert Take(take.markers, ("LFHD ", " x: y"), 1.0).bare_labels == ("LFHD", "y")


def test_a_part_is_a_take_of_the_same_file_with_those_markers_alone(take):
    """The whole's markers are the file's points 4 and 6; the part's is the second of them, wherever it is asked."""
    seen = take.visible
    whole = replace(take, columns=np.array([4, 6]), computed=~seen, uncaptured=seen, sample_sd=np.where(seen, 0.1, np.nan))
    part = whole.part(np.array([1]), "A/B")
    assert (part.labels, part.marker_subjects, part.subject_name, part.name, part.stem) == (
        ("A:B:RANK",), ("A:B",), "A/B", "walk.c3d (A/B)", "walk.A_B"
    )  # fmt: skip
    np.testing.assert_array_equal(part.markers, whole.markers[:, [1]])
    np.testing.assert_array_equal(part.computed, ~seen[:, [1]])
    np.testing.assert_array_equal(part.uncaptured, seen[:, [1]])
    np.testing.assert_array_equal(part.source_points, np.full((4, 1), 6))
    np.testing.assert_array_equal(whole.find_marker_indices(part), [1])
    np.testing.assert_array_equal(take.find_marker_indices(take.part(np.array([1, 0]), "both")), [1, 0])
    assert (take.stem, Take(take.markers, take.labels, 120.0).output_stem) == ("walk", "take")


def test_other_positions_make_another_take(take):
    deviation = np.full((4, 2), 0.001)
    other = take.replace_markers(np.zeros((4, 2, 3)), deviation)
    assert other.visible.all()
    assert other.sample_sd is deviation
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
def test_runs_make_up_the_mask_and_none_touches_the_next(drawn):
    mask, again = np.array(drawn, bool), np.zeros(len(drawn), bool)
    found = find_runs(mask)
    for first, last in found:
        assert first <= last
        again[first : last + 1] = True
    np.testing.assert_array_equal(again, mask)
    assert all(after[0] > before[1] + 1 for before, after in pairwise(found))


rings = st.tuples(st.permutations(range(5)), st.sampled_from([2, 3]), st.integers(0, 40), st.integers(0, 40))


@given(st.lists(rings, max_size=4))
def test_what_is_exchanged_back_is_the_take_bit_for_bit(drawn):
    rng = np.random.default_rng(0)
    markers, deviation, computed = rng.normal(size=(41, 5, 3)), rng.random((41, 5)), rng.random((41, 5)) < 0.1
    markers[rng.random((41, 5)) < 0.3] = np.nan
    take = Take(markers, tuple("ABCDE"), 100.0, point_columns=np.array([3, 1, 8, 9, 0]), sample_sd=deviation, computed=computed)
    done, again = [(tuple(order[:size]), min(a, b), max(a, b)) for order, size, a, b in drawn], take
    for ring, first, last in done:
        again = again.exchange_labels(ring, first, last)
    for ring, first, last in reversed(done):
        again = again.exchange_labels(ring[::-1], first, last)
    for name in ("markers", "deviation", "computed", "sources"):
        np.testing.assert_array_equal(getattr(again, name), getattr(take, name))
    for ring, first, last in [each for each in done if len(each[0]) == 2][:1]:
        twice = take.exchange_labels(ring, first, last).exchange_labels(ring, first, last)
        np.testing.assert_array_equal(twice.markers, markers)


def test_a_ring_puts_each_sample_under_its_own_label(take):
    three = Take(np.arange(9.0).reshape(1, 3, 3), tuple("abc"), 1.0, point_columns=np.array([4, 5, 6]))
    back = three.exchange_labels((0, 2, 1), 0, 0)  # the sample of a is under c's label, c's under b's, b's under a's
    np.testing.assert_array_equal(back.markers[0], three.markers[0, [2, 0, 1]])
    np.testing.assert_array_equal(back.source_points[0], [6, 4, 5])
    assert three.relabelled_points is None


def test_what_a_program_put_there_was_not_measured(take):
    computed = np.zeros((4, 2), bool)
    computed[0, 0] = computed[1, 0] = True  # the latter is not there at all
    np.testing.assert_array_equal(
        Take(take.markers, take.labels, 1.0, computed=computed).measured[:2], [[False, True], [False, True]]
    )


def test_unlabelled_trajectories_are_counted_on_from_the_labels(take):
    loose = Take(take.markers, ("*1", "*2"), 1.0)
    both = Take(take.markers, take.labels, 1.0, unlabelled=loose)
    assert [both.get_label(i) for i in range(4)] == [*take.labels, "*1", "*2"]

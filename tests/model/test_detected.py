import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model.detected import split_moved_markers
from mocapfix.model.faults import Fault, MarkerShift
from mocapfix.model.take import Take

RATE, FRAMES = 100.0, 400


def take() -> Take:
    return Take(np.random.default_rng(0).normal(size=(FRAMES, 3, 3)), tuple("ABC"), RATE)


def moved(marker, first, settled=None):
    return MarkerShift("drift" if settled else "moved", marker, first, FRAMES - 1, 0.04, "", settled_frame=settled or first)


moves = st.lists(
    st.builds(
        lambda marker, first, slide: moved(marker, first, min(first + slide, FRAMES - 1) if slide else None),
        st.integers(0, 2),
        st.integers(1, FRAMES - 1),
        st.sampled_from([0, 0, 30]),
    ),
    max_size=6,
)


def test_without_shifts_each_marker_has_one_column():
    parts = split_moved_markers(take(), [Fault("spike", 1, 100, 101, 0.1, "")])
    assert (parts.take.labels, parts.column_marker.tolist(), parts.added_columns.tolist()) == (("A", "B", "C"), [0, 1, 2], [])
    assert parts.is_active.all()


@pytest.mark.parametrize(("first", "own_column"), [(300, slice(0, 300)), (100, slice(100, 400))])
def test_original_column_holds_the_longer_epoch(first, own_column):
    whole, parts = take(), split_moved_markers(take(), [moved(1, first)])
    assert (parts.take.labels, parts.column_marker.tolist(), parts.added_columns.tolist()) == (
        ("A", "B", "C", "B"),
        [0, 1, 2, 1],
        [3],
    )
    here = np.zeros(FRAMES, bool)
    here[own_column] = True
    np.testing.assert_array_equal(parts.is_active[:, [1, 3]], np.stack([here, ~here], 1))
    np.testing.assert_array_equal(parts.take.markers[here, 1], whole.markers[here, 1])
    np.testing.assert_array_equal(parts.take.markers[~here, 3], whole.markers[~here, 1])
    assert not parts.take.visible[~here, 1].any()
    assert not parts.take.visible[here, 3].any()
    assert parts.find_column(1, first) != parts.find_column(1, first - 1)


def test_sliding_samples_are_in_no_column():
    parts = split_moved_markers(take(), [moved(1, 150, 190)])
    assert not parts.take.visible[150:190, [1, 3]].any()
    assert parts.take.visible[[149, 190]][:, [1, 3]].any(1).all()
    assert parts.find_column(1, 169) == parts.find_column(1, 149)
    near = np.ones((FRAMES, 2), bool)
    near[:150, 0] = near[190:, 1] = False  # the original column is that of the later, longer position
    np.testing.assert_array_equal(parts.is_near[:, [1, 3]], near)
    assert parts.find_column(1, 170) == parts.find_column(1, 190)


def test_short_epochs_are_ignored():
    assert len(split_moved_markers(take(), [moved(1, 400 - 49)]).added_columns) == 0
    assert len(split_moved_markers(take(), [moved(1, 400 - 50)]).added_columns) == 1
    assert len(split_moved_markers(take(), [moved(1, 200), moved(1, 230)]).added_columns) == 1


@given(moves)
def test_columns_partition_the_frames_and_merge_to_the_take(faults):
    whole, parts = take(), split_moved_markers(take(), faults)
    for m in range(3):
        np.testing.assert_array_equal(parts.is_active[:, parts.column_marker == m].sum(1), 1)
    assert not (parts.take.visible & ~parts.is_active).any()
    mask = np.random.default_rng(1).random(whole.visible.shape) < 0.5
    np.testing.assert_array_equal(parts.merge_columns(parts.split_mask(mask)), mask)
    seen = parts.merge_columns(parts.take.visible)
    np.testing.assert_array_equal(parts.merge_columns(parts.take.markers)[seen], whole.markers[seen])
    slides = np.zeros(whole.visible.shape, bool)
    for fault in faults:
        slides[fault.first : fault.settled_frame, fault.marker] = True
    assert not (~seen & ~slides).any()

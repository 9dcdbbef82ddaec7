import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix import mend
from mocapfix.faults import Fault, Moved
from mocapfix.take import Take

RATE, FRAMES = 100.0, 400


def take() -> Take:
    return Take(np.random.default_rng(0).normal(size=(FRAMES, 3, 3)), tuple("ABC"), RATE)


def moved(marker, first, settled=None):
    return Moved("drift" if settled else "moved", marker, first, FRAMES - 1, 0.04, "", settled=settled or first)


moves = st.lists(
    st.builds(
        lambda marker, first, slide: moved(marker, first, min(first + slide, FRAMES - 1) if slide else None),
        st.integers(0, 2),
        st.integers(1, FRAMES - 1),
        st.sampled_from([0, 0, 30]),
    ),
    max_size=6,
)


def test_without_a_move_each_marker_is_one_part():
    parts = mend.parted(take(), [Fault("spike", 1, 100, 101, 0.1, "")])
    assert (parts.take.labels, parts.marker.tolist(), parts.more.tolist()) == (("A", "B", "C"), [0, 1, 2], [])
    assert parts.own.all()


@pytest.mark.parametrize(("first", "own_column"), [(300, slice(0, 300)), (100, slice(100, 400))])
def test_a_knocked_markers_own_column_is_that_of_its_longer_stay(first, own_column):
    whole, parts = take(), mend.parted(take(), [moved(1, first)])
    assert (parts.take.labels, parts.marker.tolist(), parts.more.tolist()) == (("A", "B", "C", "B"), [0, 1, 2, 1], [3])
    here = np.zeros(FRAMES, bool)
    here[own_column] = True
    np.testing.assert_array_equal(parts.own[:, [1, 3]], np.stack([here, ~here], 1))
    np.testing.assert_array_equal(parts.take.markers[here, 1], whole.markers[here, 1])
    np.testing.assert_array_equal(parts.take.markers[~here, 3], whole.markers[~here, 1])
    assert not parts.take.seen[~here, 1].any()
    assert not parts.take.seen[here, 3].any()
    assert parts.column(1, first) != parts.column(1, first - 1)


def test_while_a_marker_slides_no_part_has_its_samples_and_each_speaks_for_half_of_the_way():
    parts = mend.parted(take(), [moved(1, 150, 190)])
    assert not parts.take.seen[150:190, [1, 3]].any()
    assert parts.take.seen[[149, 190]][:, [1, 3]].any(1).all()
    assert parts.column(1, 169) == parts.column(1, 149)
    assert parts.column(1, 170) == parts.column(1, 190)


def test_a_place_that_is_hardly_seen_is_none():
    assert len(mend.parted(take(), [moved(1, 400 - 49)]).more) == 0
    assert len(mend.parted(take(), [moved(1, 400 - 50)]).more) == 1
    assert len(mend.parted(take(), [moved(1, 200), moved(1, 230)]).more) == 1


@given(moves)
def test_one_part_speaks_for_each_marker_in_each_frame_and_they_make_it_up_again(faults):
    whole, parts = take(), mend.parted(take(), faults)
    for m in range(3):
        np.testing.assert_array_equal(parts.own[:, parts.marker == m].sum(1), 1)
    assert not (parts.take.seen & ~parts.own).any()
    mask = np.random.default_rng(1).random(whole.seen.shape) < 0.5
    np.testing.assert_array_equal(parts.joined(parts.split(mask)), mask)
    seen = parts.joined(parts.take.seen)
    np.testing.assert_array_equal(parts.joined(parts.take.markers)[seen], whole.markers[seen])
    slides = np.zeros(whole.seen.shape, bool)
    for fault in faults:
        slides[fault.first : fault.settled, fault.marker] = True
    assert not (~seen & ~slides).any()

import numpy as np
import pytest

from mocapfix.labels.fragments import find_loose_segments, split_trajectory
from mocapfix.model.detected import find_namesakes
from mocapfix.model.faults import overlap_in_time
from mocapfix.model.take import Take

RATE = 120.0
MOVING = np.arange(100)[:, None] / RATE * [2.0, 0.0, 1.0]  # m/s


def spans(path, rate=RATE):
    frames = np.flatnonzero(~np.isnan(path[:, 0]))
    return [(int(each[0]), int(each[-1])) for each in split_trajectory(frames, path, rate)]


def test_smooth_path_is_one_segment():
    assert spans(MOVING) == [(0, 99)]
    assert spans(MOVING[:1]) == [(0, 0)]
    assert spans(MOVING[:0]) == []


def test_pause_ends_a_segment_and_a_flicker_does_not():
    path = MOVING.copy()
    path[[20, 21, 50, 51, 52]] = np.nan
    assert spans(path) == [(0, 49), (53, 99)]


@pytest.mark.parametrize("frame", [3, 40, 97])
def test_leap_ends_a_segment(frame):
    path = MOVING.copy()
    path[frame:] += [0.0, 0.06, 0.0]
    assert spans(path) == [(0, frame - 1), (frame, 99)]


def test_sharp_bend_is_no_leap():
    assert spans(3.0 * np.abs(MOVING - MOVING[50])) == [(0, 99)]


def take_of(*labels, seen=None):
    markers = np.tile(MOVING[:, None], (1, len(labels), 1)) + np.arange(len(labels))[:, None]
    for m, count in (seen or {}).items():
        markers[count:, m] = np.nan
    return Take(markers, labels, RATE)


def test_namesakes_of_labels():
    assert find_namesakes(take_of("RBAC", "RBAC-1", "Jim:C7", "Jim:C7_2", "Stick 1", "LMT5", "LMT1", "P1")) == {1: 0, 3: 2}
    assert find_namesakes(take_of("T10", "C7 (2)", "C7", "C7.001", "C7*3")) == {1: 2, 3: 2, 4: 2}


def test_longest_of_equal_labels_is_the_marker():
    take = take_of("LELB", "LELB", "LELB", seen={0: 20, 2: 0})
    assert find_namesakes(take) == {0: 1, 2: 1}
    assert [(segment.donor, segment.namesake, len(segment.frames)) for segment in find_loose_segments(take)] == [(0, 1, 20)]


def test_unlabelled_donors_follow_the_labels():
    take = Take(MOVING[:, None], ("LELB",), RATE, unlabelled=take_of("*1", "*2"))
    assert [(segment.donor, segment.namesake) for segment in find_loose_segments(take)] == [(1, -1), (2, -1)]
    np.testing.assert_array_equal(find_loose_segments(take)[1].points, MOVING + 1)


def test_overlap_in_time():
    one, other = find_loose_segments(Take(MOVING[:, None], ("A",), RATE, unlabelled=take_of("*1", "*2", seen={0: 50})))
    assert overlap_in_time(one, other)
    late = type(other)(other.donor, -1, other.frames[50:], other.points[50:])
    assert not overlap_in_time(one, late)
    assert not overlap_in_time(late, one)

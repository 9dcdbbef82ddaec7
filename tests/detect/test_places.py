import numpy as np

from mocapfix.detect.neighbours import looseness
from mocapfix.detect.places import near, path_among, place
from tests.detect.filled import walking


def test_a_marker_of_a_rigid_segment_rests_among_the_others():
    take = walking(noise=0.0)
    loose = looseness(take.markers, take.rate)
    assert sorted(near(loose, 0)) == [1, 2, 3]
    path = path_among(take.markers, 0, loose)
    np.testing.assert_allclose(path - path[0], 0, atol=1e-9)
    there = place(take.markers, 0, loose)
    assert there is not None
    np.testing.assert_allclose(there.off, 0, atol=1e-9)
    np.testing.assert_array_equal(there.frames, np.arange(take.frames))


def test_the_turn_leads_back_to_the_world():
    take = walking(noise=0.0)
    loose = looseness(take.markers, take.rate)
    markers, was = take.markers.copy(), place(take.markers, 0, loose)
    assert was is not None
    markers[:, 0] += np.einsum("tab,b->ta", was.turn, [0.01, 0.02, 0.03])
    moved = path_among(markers, 0, loose) - path_among(take.markers, 0, loose)
    np.testing.assert_allclose(moved, np.tile([0.01, 0.02, 0.03], (take.frames, 1)), atol=1e-9)


def test_two_neighbours_tell_no_place_and_a_missing_one_leaves_its_frames_out():
    take = walking(noise=0.0)
    loose = looseness(take.markers, take.rate)
    markers = take.markers.copy()
    markers[100:200, 3] = np.nan
    there = place(markers, 0, loose)
    assert there is not None
    np.testing.assert_array_equal(there.frames, np.r_[0:100, 200 : take.frames])
    loose[0, 3] = np.inf
    assert place(take.markers, 0, loose) is None

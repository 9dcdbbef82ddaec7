import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.solve import kinematics
from mocapfix.subject.calibration import MIN_MOVED_MARKER_FRAMES, add_moved_markers
from mocapfix.synthetic import compose_take


@pytest.fixture(scope="module")
def walk():
    return compose_take(seed=1, seconds=2.0, rate=30.0)


def shown_at(walk, marker, place):
    """Return (T, 3) metres: where that marker is seen if it lies at `place` in its joint's axes"""
    position, rotation = kinematics.compute_world_poses(walk.subject.skeleton, walk.motion)
    joint = walk.subject.joints[marker]
    return position[:, joint] + rotation[:, joint] @ np.array(place)


@given(
    markers=st.lists(st.integers(0, 40), min_size=1, max_size=3),
    place=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    wrong=st.sets(st.integers(0, 59), max_size=29),
)
def test_new_offset_is_exact_with_almost_half_outliers(walk, markers, place, wrong):
    shown = np.stack([shown_at(walk, m, place) for m in markers], axis=1)
    shown[sorted(wrong)] += 1.0
    grown, enough = add_moved_markers(walk.subject, walk.motion, shown, np.array(markers))
    count = len(walk.subject.labels)
    assert enough.all()
    if not wrong:
        np.testing.assert_allclose(grown.marker_offsets[count:], np.tile(place, (len(markers), 1)), atol=1e-12)
    moved = np.linalg.norm(grown.marker_offsets[count:] - place, axis=1)
    np.testing.assert_array_less(moved, 1e-9)
    assert grown.labels[count:] == tuple(walk.subject.labels[m] for m in markers)
    for name in ("joints", "marker_spread", "marker_sd"):
        np.testing.assert_array_equal(getattr(grown, name)[count:], getattr(walk.subject, name)[markers])


def test_original_markers_are_unchanged(walk):
    shown = shown_at(walk, 3, (0.1, 0.0, 0.0))[:, None]
    grown, _ = add_moved_markers(walk.subject, walk.motion, shown, np.array([3]))
    assert grown.skeleton is walk.subject.skeleton
    count = len(walk.subject.labels)
    assert grown.labels[:count] == walk.subject.labels
    for name in ("joints", "marker_offsets", "marker_spread", "marker_sd"):
        np.testing.assert_array_equal(getattr(grown, name)[:count], getattr(walk.subject, name))


@pytest.mark.parametrize("seen", [0, MIN_MOVED_MARKER_FRAMES - 1, MIN_MOVED_MARKER_FRAMES])
def test_rarely_visible_position_is_not_added(walk, seen):
    shown = np.stack([shown_at(walk, m, (0.0, 0.1, 0.0)) for m in (3, 7)], axis=1)
    shown[seen:, 0] = np.nan
    grown, enough = add_moved_markers(walk.subject, walk.motion, shown, np.array([3, 7]))
    assert enough.tolist() == [seen >= MIN_MOVED_MARKER_FRAMES, True]
    extra = len(grown.labels) - len(walk.subject.labels)
    assert extra == len(grown.marker_offsets) - len(walk.subject.marker_offsets) == enough.sum()
    assert grown.labels[-1] == walk.subject.labels[7]


def test_invisible_position_is_not_added(walk):
    nothing = np.full((walk.motion.frame_count, 1, 3), np.nan)
    grown, enough = add_moved_markers(walk.subject, walk.motion, nothing, np.array([3]))
    assert not enough.any()
    assert grown.labels == walk.subject.labels
    assert grown.marker_offsets.shape == walk.subject.marker_offsets.shape

"""Fragments of markers are joined without a marker set."""

import numpy as np
import pytest

from mocapfix.lab.label_recovery import remove_labels
from mocapfix.labels.reference_labeller import arrange_points, join_trajectories, label_points_like, select_marker_fragments
from mocapfix.labels.tracklets import UnlabelledPoints, find_tracklets
from mocapfix.synthetic import compose_take


@pytest.fixture(scope="module")
def truth():
    return compose_take(2, seconds=6.0, rate=60.0)


@pytest.mark.parametrize("kind", ["ghosts", "cloud"])
def test_each_marker_gets_one_number(truth, kind):
    take = remove_labels(kind, truth.marker_positions, truth.rate, seed=1)
    labels, names = join_trajectories(find_tracklets(take.points, truth.rate), label_points_like)
    assert names[0] == "M01"
    assert len(names) == len(truth.labels)
    is_joined = (labels.marker_indices >= 0) & (take.marker_indices >= 0)
    pairs = np.unique(np.stack([labels.marker_indices[is_joined], take.marker_indices[is_joined]]), axis=1)
    # As many pairs of number and true marker as there are markers: neither is divided and no two are mixed.
    assert pairs.shape[1] == len(truth.labels)
    assert is_joined.sum() >= 0.98 * (take.marker_indices >= 0).sum()


def test_markers_are_the_fragments_that_are_visible_together_for_longest():
    """Two fragments in turn in each of six columns; those of the second half last longer. A ghost is brief."""
    tracklets = np.full((200, 7), -1)
    tracklets[:80, :6], tracklets[90:, :6] = np.arange(6), 6 + np.arange(6)
    tracklets[100:120, 6] = 12
    points = UnlabelledPoints(np.where(tracklets[..., None] >= 0, 0.0, np.full((200, 7, 3), np.nan)), tracklets, 60.0)
    np.testing.assert_array_equal(select_marker_fragments(points), 6 + np.arange(6))


def test_no_markers_where_too_few_points_are_visible_together():
    tracklets = np.tile(np.arange(4), (100, 1))
    labels, names = join_trajectories(UnlabelledPoints(np.zeros((100, 4, 3)), tracklets, 60.0), label_points_like)
    assert names == ()
    assert (labels.marker_indices == -1).all()


def test_arranged_points_are_in_the_columns_of_their_markers():
    positions = np.arange(18.0).reshape(2, 3, 3)
    points = UnlabelledPoints(positions, np.array([[0, 1, 2], [1, 0, 2]]), 60.0)
    arranged = arrange_points(points, np.array([[0, 1, -1], [1, 0, -1]]), 2)
    np.testing.assert_array_equal(arranged, [positions[0, :2], positions[1, [1, 0]]])

"""The labeller: tracklets of synthetic takes get the labels of a set, of a subject, and ghosts none."""

import numpy as np
import pytest

from mocapfix.lab.label_recovery import remove_labels
from mocapfix.labels.labeller import label_points
from mocapfix.labels.tracklets import (
    SampledPoints,
    TrackletDistances,
    UnlabelledPoints,
    assign_tracklets,
    compute_label_confidence,
    continue_labels,
    find_tracklets,
    label_single_points,
    measure_tracklets,
    sample_points,
)
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import SyntheticTake, compose_take

MARKER_SET = load_marker_set("cmu41")


@pytest.fixture(scope="module")
def take() -> SyntheticTake:
    return compose_take(5, 6.0, 60.0)


def measure_f1(unlabelled, marker_indices) -> float:
    is_labelled, is_marker = marker_indices >= 0, unlabelled.marker_indices >= 0
    right = (is_labelled & (marker_indices == unlabelled.marker_indices)).sum()
    return 2 * right / (is_labelled.sum() + is_marker.sum())


@pytest.mark.parametrize("kind", ["ghosts", "cloud"])
def test_labels_of_a_set_are_found(take, kind):
    unlabelled = remove_labels(kind, take.marker_positions, take.rate, seed=1)
    labels = label_points(find_tracklets(unlabelled.points, take.rate), MARKER_SET)
    assert measure_f1(unlabelled, labels.marker_indices) > 0.998
    assert (labels.confidence[labels.marker_indices >= 0] >= 0.5).all()
    assert (labels.confidence <= 1).all()


def test_a_few_scattered_points_get_no_labels():
    positions = np.random.default_rng(0).normal(size=(1, 6, 3)).repeat(100, 0)
    labels = label_points(find_tracklets(positions, 100.0), MARKER_SET)
    assert (labels.marker_indices == -1).all()


def test_tracklets_visible_at_once_have_different_markers():
    positions = np.zeros((10, 3, 3))
    positions[:, 1, 0], positions[:, 2, 0] = 0.01, 1.0
    points = UnlabelledPoints(positions, np.tile(np.arange(3), (10, 1)), 10.0)
    sampled = sample_points(points)
    predicted = np.zeros((len(sampled.frames), 2, 3))
    predicted[:, 1, 0] = 0.03
    distances = measure_tracklets(sampled, predicted, 0.2)
    assert distances.squared_m2[1] == pytest.approx([1e-4, 4e-4])
    assert assign_tracklets(sampled, distances.squared_m2, np.full(3, 0.1)).tolist() == [0, 1, -1]


def test_points_of_an_overlap_get_a_label_once():
    """Two tracklets have one label; where both are visible, the one nearer to the marker keeps it."""
    positions = np.full((40, 2, 3), np.nan)
    positions[:25, 0] = [0.0, 0.0, 0.0]
    positions[20:25, 0, 0] = 0.1  # what the first shows at its end is another thing
    positions[20:, 1] = [0.005, 0.0, 0.0]
    indices = np.where(np.isnan(positions[..., 0]), -1, [0, 1])
    points = UnlabelledPoints(positions, indices, 40.0)
    sampled = sample_points(points)
    markers = label_single_points(points, sampled, np.zeros((len(sampled.frames), 1, 3)), np.array([0, 0]))
    assert (markers[:20, 0] == 0).all()
    assert (markers[20:25, 0] == -1).all()
    assert (markers[20:, 1] == 0).all()


def test_label_continues_in_its_column_across_a_leap():
    positions = np.zeros((30, 1, 3))
    positions[10:20, 0, 0] = 0.2
    points = UnlabelledPoints(positions, np.repeat([0, 1, 2], 10)[:, None], 50.0)
    labelled = np.repeat([4, -1, 4], 10)[:, None]
    assert (continue_labels(points, labelled) == 4).all()
    positions[10:20, 0, 0] = 0.4
    np.testing.assert_array_equal(continue_labels(points, labelled), labelled)


def test_wrist_and_hand_exchanged_from_the_beginning_are_corrected():
    """Before the labels were reconsidered, three markers of the left hand had each other's labels throughout this take."""
    take = compose_take(21, 10.0, 120.0, asymmetric=True)
    visible_markers = np.where(take.missing_mask[..., None], np.nan, take.marker_positions)
    unlabelled = remove_labels("ghosts", visible_markers, take.rate, seed=1)
    found = label_points(find_tracklets(unlabelled.points, take.rate), load_marker_set("cmu41")).marker_indices
    assert (found == unlabelled.marker_indices)[unlabelled.marker_indices >= 0].all()


def test_a_single_point_is_less_certain_than_a_trajectory():
    """Both are 3 cm from the marker; most single points that far from it are ghosts."""
    times, positions = np.arange(40) * 0.05, np.zeros((40, 2, 3))
    tracklets = np.where(np.arange(40)[:, None] == [[5, 0]], [[1, 0]], -1)
    tracklets[:, 1] = 0
    sampled = SampledPoints(np.arange(40), positions, tracklets, 2, times)
    distances = TrackletDistances(np.array([[0.03**2, 1.0], [1.0, 0.03**2]]), np.array([40, 1]))
    confidence = compute_label_confidence(sampled, np.array([0, 1]), distances)
    assert confidence[0] > 0.99
    assert 0.2 < confidence[1] < 0.9

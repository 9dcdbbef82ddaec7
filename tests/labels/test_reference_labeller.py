"""Labels by a labelled take of the same person, whose markers are in no known set."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab.label_recovery import remove_labels
from mocapfix.labels.reference_labeller import build_reference_markers, label_points_like
from mocapfix.labels.tracklets import find_tracklets
from mocapfix.synthetic import compose_take

RATE = 60.0


@pytest.fixture(scope="module")
def halves() -> tuple[np.ndarray, np.ndarray]:
    """Return the two halves of a take, the second one turned and elsewhere."""
    markers = compose_take(5, 10.0, RATE).marker_positions
    turned = markers[300:] @ Rotation.from_euler("y", 2.0).as_matrix().T + [3.0, 0.0, -1.0]
    return markers[:300], turned


@pytest.mark.parametrize("kind", ["ghosts", "cloud"])
def test_other_half_of_a_take_is_labelled(halves, kind):
    reference = build_reference_markers(halves[0], tuple(f"K{n}" for n in range(halves[0].shape[1])))
    unlabelled = remove_labels(kind, halves[1], RATE, seed=2)
    found = label_points_like(find_tracklets(unlabelled.points, RATE), reference).marker_indices
    is_marker = unlabelled.marker_indices >= 0
    assert (found == unlabelled.marker_indices)[is_marker].mean() > 0.99
    assert (found[(found >= 0)] == unlabelled.marker_indices[found >= 0]).mean() > 0.995


def test_moved_and_missing_markers_mislead_no_others(halves):
    reference = build_reference_markers(halves[0], tuple(f"K{n}" for n in range(halves[0].shape[1])))
    markers = np.delete(halves[1], 7, axis=1)
    markers[:, 20] += [0.0, 0.03, 0.0]
    truth = np.delete(np.arange(halves[1].shape[1]), 7)
    points = find_tracklets(remove_labels("tracks", markers, RATE, seed=3).points, RATE)
    expected = np.append(truth, -1)[remove_labels("tracks", markers, RATE, seed=3).marker_indices]
    found = label_points_like(points, reference).marker_indices
    assert (found == expected)[expected >= 0].mean() > 0.99


def test_a_mirrored_person_is_not_labelled_as_the_person(halves):
    """The distances are those of the person, the arrangement of the markers is not."""
    reference = build_reference_markers(halves[0], tuple(f"K{n}" for n in range(halves[0].shape[1])))
    positions = halves[0][:40]
    assert np.nanmedian(np.linalg.norm(reference.predict(positions) - positions, axis=-1)) < 0.01
    mirrored = positions * [-1.0, 1.0, 1.0]
    assert np.nanmedian(np.linalg.norm(reference.predict(mirrored) - mirrored, axis=-1)) > 0.02


def test_markers_without_three_neighbours_have_no_place(halves):
    reference = build_reference_markers(halves[0], tuple(f"K{n}" for n in range(halves[0].shape[1])))
    positions = np.full_like(halves[0][:5], np.nan)
    positions[:, :2] = halves[0][:5, :2]
    assert np.isnan(reference.predict(positions)).all()

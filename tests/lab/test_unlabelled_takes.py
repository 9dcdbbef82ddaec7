"""Takes without labels: every point is where its marker is, and the damage is what its kind names."""

import numpy as np
import pytest

from mocapfix.errors import SceneError
from mocapfix.lab.label_recovery import MAX_FRAME_GHOSTS, UnlabelledKind, place_two_people, remove_labels
from mocapfix.labels.tracklets import are_points_unordered
from mocapfix.synthetic import compose_take

RATE = 60.0
KINDS: tuple[UnlabelledKind, ...] = ("tracks", "ghosts", "cloud", "noise", "broken")


@pytest.fixture(scope="module")
def markers() -> np.ndarray:
    markers = compose_take(1, 8.0, RATE).marker_positions.copy()
    markers[100:150, 4] = np.nan
    return markers


@pytest.mark.parametrize("kind", KINDS)
def test_points_are_their_markers(markers: np.ndarray, kind: UnlabelledKind) -> None:
    take = remove_labels(kind, markers, RATE, seed=2)
    frames, columns = np.nonzero(take.marker_indices >= 0)
    np.testing.assert_array_equal(take.points[frames, columns], markers[frames, take.marker_indices[frames, columns]])
    assert len(set(zip(frames.tolist(), take.marker_indices[frames, columns].tolist(), strict=True))) == len(frames)
    has_ghosts = (~np.isnan(take.points[..., 0]) & (take.marker_indices < 0)).any()
    assert has_ghosts == (kind in ("ghosts", "noise", "broken"))
    assert are_points_unordered(take.points) == (kind == "cloud")
    np.testing.assert_array_equal(remove_labels(kind, markers, RATE, seed=2).points, take.points)


def test_a_trajectory_shows_one_marker_without_gaps(markers: np.ndarray) -> None:
    take = remove_labels("tracks", markers, RATE)
    assert take.points.shape[1] > markers.shape[1]
    for column in range(take.points.shape[1]):
        frames = np.flatnonzero(take.marker_indices[:, column] >= 0)
        assert (np.diff(frames) == 1).all()
        assert len(set(take.marker_indices[frames, column].tolist())) == 1


def test_broken_trajectories_are_columns_of_their_own(markers: np.ndarray) -> None:
    noise, broken = remove_labels("noise", markers, RATE), remove_labels("broken", markers, RATE)
    assert noise.points.shape[1] == markers.shape[1] + MAX_FRAME_GHOSTS
    assert broken.points.shape[1] == noise.points.shape[1] + 50


def test_people_are_apart_and_cross(markers: np.ndarray) -> None:
    labels = tuple(f"M{m}" for m in range(markers.shape[1]))
    for crossing, distance_m in ((False, 1.0), (True, 0.6)):
        take = place_two_people(markers, markers[:400], (labels, labels), distance_m, crossing=crossing)
        assert take.markers.shape == (400, 2 * len(labels), 3)
        assert take.labels[0] == "P1:M0"
        assert take.labels[take.first_count] == "P2:M0"
        centres = [
            np.nanmedian(take.markers[:, part][..., [0, 2]], axis=1) for part in (slice(0, len(labels)), slice(len(labels), None))
        ]
        distance = np.linalg.norm(centres[1] - centres[0], axis=1)
        assert distance_m <= distance.min() < distance_m + 0.1
        own = take.markers[:, take.first_count :]
        height_change = own[..., 1] - markers[:400, :, 1]
        np.testing.assert_allclose(height_change[~np.isnan(height_change)], 0, atol=1e-12)


def test_people_that_cannot_be_apart_are_refused(markers: np.ndarray) -> None:
    labels = tuple(f"M{m}" for m in range(markers.shape[1]))
    with pytest.raises(SceneError, match="cannot be placed 50 m apart"):
        place_two_people(markers, markers, (labels, labels), 50.0)

import numpy as np

from mocapfix.detect.external_fills import estimate_distance_changes
from tests.detect.filled import walking


def test_distance_changes_of_rigid_and_other_markers():
    take = walking(noise=0.0)
    loose = estimate_distance_changes(take.markers, take.rate)
    assert np.isinf(np.diag(loose)).all()
    np.testing.assert_allclose(loose[~np.eye(4, dtype=bool)], 0, atol=1e-12)
    free = take.markers.copy()
    free[:, 3] = [0.0, 1.0, 0.0]
    loose = estimate_distance_changes(free, take.rate)
    assert loose[0, 1] < 1e-12
    assert loose[0, 3] > 0.3
    np.testing.assert_array_equal(loose, loose.T)


def test_single_shift_hardly_affects_distance_changes():
    take = walking(noise=0.0, seconds=12)
    markers = take.markers.copy()
    markers[700:, 0] += [0.1, 0.0, 0.0]
    assert (
        estimate_distance_changes(markers, take.rate)[0, 1] > 1e-3
    )  # it moved in the world's axes, so its distance varies from there on
    markers = take.markers.copy()
    markers[700:, 0] += markers[700:, 0] - markers[700:, 1]  # twice as far along the line through the two
    assert estimate_distance_changes(markers, take.rate)[0, 1] < 1e-12


def test_distance_changes_of_rarely_visible_pairs_are_unknown():
    take = walking()
    markers = take.markers.copy()
    markers[:240, 0], markers[240:, 1] = np.nan, np.nan
    loose = estimate_distance_changes(markers, take.rate)
    assert np.isinf(loose[0, 1])
    assert np.isfinite(loose[0, 2])

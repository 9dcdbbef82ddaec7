import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.detect.body_outliers import BodyOutlier, BodyResiduals, carry_rigidly, is_body_wrong, measure_leaps_from_neighbours
from mocapfix.stats.marker_distances import estimate_distances
from tests.detect.bodies import turning

FIRST, LAST = 200, 207


def build_residuals(markers, expected):
    """Return the residuals of markers (T, K, 3) whose segments' axes are those of the world."""
    return BodyResiduals(markers, expected, markers - expected, np.full(markers.shape[:2], 0.005))


def build_outlier(marker, distance_m):
    return BodyOutlier(marker, np.arange(FIRST, LAST + 1), distance_m, 40.0)


def test_lost_limb_is_no_fault_of_its_markers():
    """The solved body leaves a segment of five markers for eight frames."""
    markers = turning().markers
    expected = markers.copy()
    expected[FIRST : LAST + 1, :5] += [0.3, 0.1, 0.0]
    residuals, distances = build_residuals(markers, expected), estimate_distances(markers)
    assert all(is_body_wrong(build_outlier(marker, 0.32), residuals, distances) for marker in range(5))


def test_wrong_turn_of_a_segment_is_no_fault_of_its_markers():
    """The body has the segment turned by 60 degrees: its markers lie off it in different directions."""
    markers = turning().markers
    expected, centre = markers.copy(), markers[FIRST : LAST + 1, :5].mean(1, keepdims=True)
    turn = Rotation.from_euler("y", 60, degrees=True).as_matrix()
    expected[FIRST : LAST + 1, :5] = centre + (markers[FIRST : LAST + 1, :5] - centre) @ turn
    residuals, distances = build_residuals(markers, expected), estimate_distances(markers)
    distance_m = np.linalg.norm(markers - expected, axis=-1)[FIRST]
    assert all(is_body_wrong(build_outlier(marker, distance_m[marker]), residuals, distances) for marker in range(5))


@pytest.mark.parametrize("size", [0.025, 0.1, 0.4])
@pytest.mark.parametrize("direction", np.vstack([np.eye(3), -np.eye(3)]))
def test_marker_off_its_place_is_a_fault(size, direction):
    expected = turning().markers
    markers = expected.copy()
    markers[FIRST : LAST + 1, 2] += size * direction
    residuals, distances = build_residuals(markers, expected), estimate_distances(markers)
    assert not is_body_wrong(build_outlier(2, size), residuals, distances)
    leap_m = measure_leaps_from_neighbours(markers, distances, 2, np.array([[FIRST - 1, FIRST], [FIRST - 5, FIRST - 4]]))
    np.testing.assert_allclose(leap_m, [size, 0.0], atol=0.004)


def test_marker_with_few_neighbours_or_none_is_judged_by_the_body():
    expected = turning(segments=1, each=3).markers
    markers = expected.copy()
    markers[FIRST : LAST + 1, 2] += [0.0, 0.05, 0.0]
    for shown in (markers, markers[:, 2:]):
        residuals, distances = build_residuals(shown, expected[:, -shown.shape[1] :]), estimate_distances(shown)
        assert not is_body_wrong(build_outlier(shown.shape[1] - 1, 0.05), residuals, distances)


def test_rigid_motion_carries_a_point():
    rng = np.random.default_rng(0)
    before, point, shift = rng.normal(scale=0.1, size=(4, 3)), rng.normal(scale=0.1, size=3), np.array([1.0, 0.2, -0.3])
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    carried = carry_rigidly(before, before @ turn.T + shift, np.ones(4), point)
    np.testing.assert_allclose(carried, turn @ point + shift, atol=1e-12)
    line = np.linspace(0, 0.3, 4)[:, None] * [1.0, 0.0, 0.0]
    assert np.isnan(carry_rigidly(line, line, np.ones(4), point)).all()
    assert np.isnan(carry_rigidly(before[:2], before[:2], np.ones(2), point)).all()

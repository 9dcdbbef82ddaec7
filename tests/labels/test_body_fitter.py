import numpy as np
import pytest

from mocapfix.labels import label_swaps
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.average_body import (
    build_average_subject,
    build_posed_body,
    compute_rest_marker_positions,
    estimate_body_size_ratio,
)
from tests.detect.people import CMU41, compose_person

SKELETON = load_cmu31_body().skeleton
RESTING = compute_rest_marker_positions(CMU41)


def fitted(markers):
    size = estimate_body_size_ratio(CMU41, markers, min_frames=1)
    return label_swaps.fit_markers(build_posed_body(build_average_subject(CMU41, size)), markers)


def test_rest_markers_are_symmetric_in_a_t_pose():
    at = dict(zip(CMU41.labels, RESTING, strict=True))
    np.testing.assert_allclose(at["LTOE"] * [-1, 1, 1], at["RTOE"], atol=1e-12)
    assert at["LFIN"][0] > 0.7
    assert abs(at["LFIN"][1] - at["LSHO"][1]) < 0.1
    assert at["LTOE"][2] > at["LHEE"][2] + 0.2  # it faces +Z


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.3])
def test_size_ratio_from_distances_within_segments(scale):
    markers = np.tile(RESTING * scale, (3, 1, 1))
    assert estimate_body_size_ratio(CMU41, markers, min_frames=1) == pytest.approx(scale)
    markers[0, 5] = markers[1, 7] = np.nan
    assert estimate_body_size_ratio(CMU41, markers, min_frames=1) == pytest.approx(scale)


def test_size_ratio_is_one_without_visible_distances():
    assert estimate_body_size_ratio(CMU41, np.full((2, 41, 3), np.nan), min_frames=1) == 1.0


def test_predicted_markers_match_the_measured_ones():
    markers = np.ascontiguousarray(compose_person().markers[::30])
    off = np.linalg.norm(fitted(markers) - markers, axis=-1)
    assert np.median(off) < 0.03  # marker offsets vary by 12 mm per axis, bones by some per cent
    assert off.max() < 0.12


def test_missing_markers_are_predicted():
    markers = np.ascontiguousarray(compose_person().markers[:1])
    hidden = markers.copy()
    hidden[0, CMU41.labels.index("LTOE")] = np.nan
    placed = fitted(hidden)
    np.testing.assert_allclose(placed[0, CMU41.labels.index("LTOE")], markers[0, CMU41.labels.index("LTOE")], atol=0.06)


def test_misfit_is_half_a_squared_sd_and_bounded():
    at = np.array([[0.003, 0, 0], [0, 0.1, 0], [1e3, 0, 0], [np.nan, np.nan, np.nan]])
    worst = 0.5 * 0.1**2 / 0.03**2
    np.testing.assert_allclose(label_swaps.compute_marker_misfit(at, np.zeros(3)), [0.005, worst / 2, worst, 0], rtol=2e-3)

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from mocapfix.detect import external_fills
from mocapfix.detect.external_fills import POLYNOMIAL_NAMES
from mocapfix.io import capture
from mocapfix.model.take import Take
from tests.captures import CAPTURES, needs_captures
from tests.detect.filled import as_floats, as_integers, walking


def filled(take, marker, first, last, degree):
    """Fill first..last of a marker with a polynomial through the adjacent samples."""
    markers = take.markers.copy()
    gap, beside = np.arange(first, last + 1), {1: [-1, 1], 2: [-2, -1, 1], 3: [-2, -1, 1, 2]}[degree]
    at = np.array([first + k if k < 0 else last + k for k in beside])
    scale = last - first + 1
    for a in range(3):
        fit = np.polynomial.Polynomial.fit((at - first) / scale, markers[at, marker, a], degree)
        markers[gap, marker, a] = fit((gap - first) / scale)
    return take.replace_markers(markers)


@given(
    rate=st.sampled_from([60.0, 120.0, 250.0]),
    start=st.floats(0.5, 2.0),
    seconds=st.floats(0.2, 1.5),
    degree=st.sampled_from([1, 2, 3]),
)
def test_fill_is_found_with_its_degree(rate, start, seconds, degree):
    first, last = round(start * rate), round((start + seconds) * rate)
    (fault,) = external_fills.detect_polynomial_fills(as_floats(filled(walking(rate), 1, first, last, degree)))
    assert (fault.marker, fault.kind) == (1, "straight")
    assert POLYNOMIAL_NAMES[degree] in fault.reason
    assert abs(fault.first - first) <= 1  # a cubic may fit one more measured sample
    assert abs(fault.last - last) <= 1


@pytest.mark.parametrize("degree", [1, 3])
def test_fill_in_an_integer_file(degree):
    (fault,) = external_fills.detect_polynomial_fills(as_integers(filled(walking(), 1, 200, 259, degree)))
    np.testing.assert_allclose([fault.first, fault.last], [200, 259], rtol=0, atol=3)


def test_spline_across_one_gap_is_a_cubic():
    take = walking()
    markers, gap = take.markers.copy(), np.arange(200, 240)
    others = np.delete(np.arange(len(markers)), gap)
    markers[gap, 3] = CubicSpline(others, markers[others, 3])(gap)
    (fault,) = external_fills.detect_polynomial_fills(take.replace_markers(markers))
    assert (fault.marker, fault.first, fault.last) == (3, 200, 239)
    assert "cubic" in fault.reason


def test_reason_and_confidence():
    (fault,) = external_fills.detect_polynomial_fills(filled(walking(), 1, 200, 259, 1))
    assert fault.reason == (
        "B lies on an exact line for 0.50 s, as other programs fill gaps; "
        f"the measured samples around it deviate from one by {fault.severity * 1e3:.2g} mm."
    )
    assert 0.99 < fault.confidence <= 1


def test_adjacent_fills_and_fills_next_to_a_gap():
    take = filled(filled(walking(), 1, 200, 230, 3), 1, 232, 280, 1)
    markers = take.markers.copy()
    markers[100:140, 1] = np.linspace(markers[100, 1], markers[140, 1], 40)
    markers[80:100, 1] = np.nan
    markers[60:80, 1] = np.nan
    ends = [(f.first, f.last) for f in external_fills.detect_polynomial_fills(take.replace_markers(markers))]
    np.testing.assert_allclose(ends, [(100, 138), (200, 230), (232, 280)], rtol=0, atol=1)


def test_measured_motion_is_no_fill():
    """Also a body in free fall, on a parabola but for the noise; and one at rest, in a file of coarse integers."""
    for rate in (50.0, 120.0, 250.0):
        assert external_fills.detect_polynomial_fills(as_floats(walking(rate, noise=1e-4))) == []
    t = np.arange(240) / 120
    fall = np.stack([2 * t, 1.5 + 4 * t - 4.9 * t**2, 0 * t], -1)[:, None]
    assert (
        external_fills.detect_polynomial_fills(
            as_floats(Take(fall + np.random.default_rng(1).normal(0, 1e-4, fall.shape), ("A",), 120.0))
        )
        == []
    )
    rest = np.random.default_rng(2).normal(0, 2e-5, (600, 3, 3)) + np.arange(9.0).reshape(3, 3) / 10
    assert external_fills.detect_polynomial_fills(as_integers(Take(rest, ("A", "B", "C"), 120.0))) == []


def test_frozen_marker_is_no_polynomial_fill():
    take = walking()
    markers = take.markers.copy()
    markers[200:260, 0] = markers[200, 0]
    assert external_fills.detect_polynomial_fills(take.replace_markers(markers)) == []


def test_short_stretch_is_no_fill():
    assert external_fills.detect_polynomial_fills(filled(walking(), 1, 200, 206, 1)) == []


def test_empty_takes():
    assert external_fills.detect_polynomial_fills(Take(np.zeros((10, 0, 3)), (), 120.0)) == []
    assert external_fills.detect_polynomial_fills(Take(np.zeros((0, 2, 3)), ("a", "b"), 120.0)) == []
    assert external_fills.detect_polynomial_fills(Take(np.full((50, 2, 3), np.nan), ("a", "b"), 120.0)) == []
    assert external_fills.detect_polynomial_fills(Take(np.zeros((50, 2, 3)), ("a", "b"), 120.0)) == []


@needs_captures
@pytest.mark.parametrize(
    ("name", "filled"),
    [("cmu/01_01", 7), ("cmu/85_02", 0), ("c3d/tennis_serve_motive", 2), ("c3d/HDM_bd_05-01_01_120", 0), ("c3d/squat", 0)],
)
def test_fills_in_captures(name, filled):
    """01_01 was filled with cubics, RFRM over 0.4 s; the serve with two lines; 85_02 is smoothed, HDM05 coarse: both measured."""
    assert len(external_fills.detect_polynomial_fills(capture.read_take(CAPTURES / f"{name}.c3d"))) == filled

import numpy as np
import pytest

from mocapfix.detect import external_fills
from mocapfix.stats import sequences
from tests.detect.filled import as_floats, as_integers, walking


@pytest.mark.parametrize("scale", [5e-5, 1e-4, 5e-4])
def test_resolution_of_an_integer_file(scale):
    np.testing.assert_allclose(sequences.estimate_resolution(as_integers(walking(), scale).markers), scale, rtol=1e-6)
    np.testing.assert_allclose(sequences.estimate_resolution(as_floats(as_integers(walking(), scale)).markers), scale, rtol=0.03)


def test_resolution_of_a_float_file():
    markers = as_floats(walking()).markers
    assert (
        sequences.estimate_resolution(markers) == sequences.compute_float_resolution(markers) == 2.0**-23 * np.abs(markers).max()
    )


def test_polynomial_misfits():
    path = np.arange(20.0)[:, None] ** 2 * [1.0, 0.5, 0.0]
    assert external_fills.compute_polynomial_misfits(path, 2, 12, np.array([0, 5])).max() < 1e-10
    line = external_fills.compute_polynomial_misfits(
        path[:3], 1, 3, np.array([0])
    )  # through 0, 1, 4 the best line misses by 1/3, 2/3, 1/3
    np.testing.assert_allclose(line, [2 / 3], rtol=1e-12)


def test_exact_stretches_end_with_the_polynomial():
    path = np.random.default_rng(0).normal(0, 1e-3, (60, 3))
    path[10:30] = np.arange(20.0)[:, None] * [0.01, 0.02, 0.0]
    path[45:] = 0.5
    assert external_fills.find_exact_stretches(path, 1, 8, 1e-7) == [(10, 29), (45, 59)]
    assert external_fills.find_exact_stretches(path, 0, 8, 1e-7) == [(45, 59)]
    path[20] = np.nan
    assert external_fills.find_exact_stretches(path, 1, 8, 1e-7) == [(10, 19), (21, 29), (45, 59)]

"""Statistics of sequences: rows that differ most, medians of what is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d

from mocapfix.stats import sequences


def test_farthest_rows_begin_at_the_mean_and_do_not_repeat() -> None:
    values = np.array([[0.0], [10.0], [4.9], [5.1], [10.0]])
    assert sequences.select_farthest_rows(values, 3) == [3, 0, 1]
    assert sorted(sequences.select_farthest_rows(values, 5)) == [0, 1, 2, 3, 4]
    assert len(set(sequences.select_farthest_rows(np.zeros((4, 2)), 4))) == 4


@pytest.mark.parametrize("shape", [(1,), (2,), (7, 3), (60, 4), (8, 1)])
def test_known_medians_are_those_of_numpy(shape: tuple[int, ...]) -> None:
    random = np.random.default_rng(0)
    for missing in (0.0, 0.3, 0.6):
        values = random.normal(size=shape)
        values[random.random(shape) < missing] = np.nan
        values[0] = 1.0
        np.testing.assert_array_equal(sequences.compute_known_medians(values), np.nanmedian(values, axis=0))
    assert np.isnan(sequences.compute_known_medians(np.full(shape, np.nan))).all()


@pytest.mark.parametrize("window", [1, 4, 7])
def test_means_over_windows_are_those_of_scipy(window: int) -> None:
    values = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(
        sequences.average_windows(values, window), uniform_filter1d(values, window, axis=0, mode="nearest"), atol=1e-12
    )


@pytest.mark.parametrize("frames", [1, 2, 20])
def test_windows_and_smoothed_values_are_those_of_scipy(frames: int) -> None:
    values = np.random.default_rng(0).normal(size=(frames, 3))
    windows = sequences.slide_windows(values, 7)
    np.testing.assert_array_equal(windows.max(-1), maximum_filter1d(values, 7, axis=0))
    np.testing.assert_array_equal(windows.min(-1), minimum_filter1d(values, 7, axis=0))
    np.testing.assert_array_equal(np.median(windows, axis=-1), median_filter(values, (7, 1), mode="nearest"))
    for sd, reach_sd in ((0.5, 4.0), (3.0, 4.0), (2.0, 3.0)):
        expected = gaussian_filter1d(values, sd, axis=0, mode="nearest", truncate=reach_sd)
        np.testing.assert_allclose(sequences.smooth_values(values, sd, reach_sd), expected, atol=1e-12)

import numpy as np
import pytest

from mocapfix.detect import marker_shifts
from mocapfix.detect.marker_shifts import regress_out


def made(off, features):
    """Regress features (N, F) out of a path `off` (N, 3)."""
    return regress_out(features, off, np.arange(len(off)), 0.003)


@pytest.mark.parametrize(("start", "end"), [(99, 100), (60, 140), (0, 199), (150, 198)])
def test_ramp_with_a_change_of_pose_is_found_exactly(start, end):
    rng = np.random.default_rng(0)
    shape = np.cumsum(rng.normal(0, 0.01, (200, 4)), axis=0)
    ramp, way = np.clip((np.arange(200) - start) / (end - start), 0, 1), np.array([0.03, -0.01, 0.02])
    there = made(np.outer(ramp, way), shape)
    pairs = np.array([(a, b) for a in range(0, 200, 3) for b in range(a + 1, 200, 7)] + [(start, end)])
    change = marker_shifts.fit_best_ramp(there, *pairs.T)
    assert (change.start, change.end) == (start, end)
    np.testing.assert_allclose(change.displacement, way, atol=1e-10)
    np.testing.assert_allclose(change.compute_progress(200), ramp, atol=1e-12)
    assert marker_shifts.compute_residual_rms(there, change, 1) < 1e-10


def test_gain_equals_that_of_least_squares():
    rng = np.random.default_rng(1)
    off = rng.normal(size=(80, 3))
    off -= off.mean(0)
    there = made(off, np.zeros((80, 1)))
    change = marker_shifts.fit_best_ramp(there, np.array([29]), np.array([30]))
    parts = off[:30] - off[:30].mean(0), off[30:] - off[30:].mean(0)
    np.testing.assert_allclose(change.gain_m2, (off**2).sum() - sum((part**2).sum() for part in parts), rtol=1e-10)
    np.testing.assert_allclose(change.displacement, off[30:].mean(0) - off[:30].mean(0), rtol=1e-10)


def test_short_path_has_no_ramp():
    there = made(np.zeros((10, 3)), np.zeros((10, 1)))
    assert marker_shifts.fit_step(there, 6) is None
    assert marker_shifts.fit_slow_ramp(there, 12, 2) is None


def test_rates_below_the_windows_have_ramps():
    off = np.random.default_rng(2).normal(size=(20, 3))
    there = made(off, np.zeros((20, 1)))
    step, slide = marker_shifts.fit_step(there, 0), marker_shifts.fit_slow_ramp(there, 0, 0)
    assert step
    assert slide
    assert marker_shifts.compute_residual_rms(there, step, 0) > 0

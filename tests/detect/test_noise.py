import numpy as np
import pytest

from mocapfix.detect import noise
from mocapfix.model.take import Take


def swinging(sd, rate=120.0, seconds=6.0, seed=0):
    """Build a take of markers that oscillate by 0.3 m, each with white noise of its own `sd` (M,) metres per axis."""
    t = np.arange(round(rate * seconds)) / rate
    path = 0.3 * np.stack([np.sin(6 * t), np.cos(4 * t), np.sin(3 * t)], -1)[:, None] * np.ones((1, len(sd), 1))
    wobble = np.random.default_rng(seed).normal(0, 1, path.shape) * np.array(sd)[:, None]
    return Take(path + wobble, tuple(f"M{m}" for m in range(len(sd))), rate)


@pytest.mark.parametrize("rate", [60.0, 120.0, 250.0])
def test_noise_level_is_the_standard_deviation(rate):
    sd = np.array([0.0002, 0.001, 0.005])
    np.testing.assert_allclose(noise.estimate_noise_levels(swinging(sd, rate)), sd, rtol=0.12)


def test_noise_level_ignores_spikes_gaps_and_bursts():
    take = swinging([0.001, 0.001])
    markers, rng = take.markers.copy(), np.random.default_rng(1)
    markers[::40, 0] += 0.2
    markers[100:220, 0] = np.nan
    markers[400:480, 0] += rng.normal(0, 0.02, (80, 3))
    assert noise.estimate_noise_levels(take.replace_markers(markers))[0] == pytest.approx(0.001, rel=0.5)


def test_noisy_marker_is_found():
    (fault,) = noise.detect_noise(swinging([0.0003, 0.0003, 0.004, 0.0004]))
    assert (fault.kind, fault.marker, fault.first, fault.last) == ("noise", 2, 0, 719)
    assert fault.severity == pytest.approx(0.004, rel=0.1)
    assert fault.reason == f"M2 has noise of {fault.severity * 1e3:.1f} mm throughout; the other markers have 0.3 mm."


@pytest.mark.parametrize("sd", [[0.0001, 0.0001, 0.0008], [0.001, 0.001, 0.004], [0.004, 0.004, 0.004]])
def test_small_or_common_noise_is_no_fault(sd):
    assert noise.detect_noise(swinging(sd)) == []


def test_rarely_visible_marker_has_no_noise_level():
    take = swinging([0.0003, 0.004, 0.0003])
    markers = take.markers.copy()
    markers[10:, 1] = np.nan
    levels = noise.estimate_noise_levels(take.replace_markers(markers))
    assert np.isnan(levels).tolist() == [False, True, False]
    assert noise.detect_noise(take.replace_markers(markers)) == []


def test_single_marker_is_not_noisy():
    assert noise.detect_noise(swinging([0.01])) == []
    assert noise.detect_noise(Take(np.zeros((0, 0, 3)), (), 100.0)) == []


def test_cubic_residuals():
    t = np.sort(np.random.default_rng(0).uniform(0, 1, 30))
    cubic = np.stack([t**3, 1 - t**2, 2 * t], -1)
    assert noise.compute_cubic_residuals(t, cubic).max() < 1e-9
    even = np.arange(30) / 100
    lone = np.zeros((30, 3))
    lone[15, 1] = 0.01
    gain = np.sqrt(1 + (2 * 4**2 + 2) / 36)  # Lagrange: (4 (a + b) - (c + d)) / 6 of the four neighbours
    assert noise.compute_cubic_residuals(even, lone)[15] == pytest.approx(0.01 / gain)

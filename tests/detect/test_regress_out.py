import numpy as np
import pytest

from mocapfix.detect.marker_shifts import regress_out

COUNT, RIDGE = 400, 0.1


def features(spread):
    """Return two independent features (N, 2) with standard deviation `spread`."""
    t = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)
    return spread * np.sqrt(2) * np.stack([np.sin(3 * t), np.cos(5 * t)], -1)


@pytest.mark.parametrize("spread", [0.01, 0.1, 1.0])
def test_significant_features_are_regressed_out(spread):
    path = features(spread) @ np.array([[0.02, 0.0, 0.01], [0.0, 0.03, 0.0]])
    there = regress_out(features(spread), path + [1.0, 2.0, 3.0], np.arange(COUNT), RIDGE)
    np.testing.assert_allclose(there.residual, path * RIDGE**2 / (spread**2 + RIDGE**2), atol=1e-12)


def test_unrelated_path_is_kept_without_its_mean():
    path = np.random.default_rng(0).normal(size=(COUNT, 3))
    still = regress_out(np.zeros((COUNT, 0)), path, np.arange(COUNT), RIDGE)
    np.testing.assert_allclose(still.residual, path - path.mean(0), atol=1e-12)
    without = path - path.mean(0) - features(1) @ (features(1).T @ path) / COUNT
    np.testing.assert_allclose(regress_out(features(1), without, np.arange(COUNT), RIDGE).residual, without, atol=1e-12)

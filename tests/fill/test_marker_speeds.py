import numpy as np

from mocapfix.fill.fill_methods import MAX_SPEED_RATIO, measure_speed_limit, measure_velocity_variation

RATE = 100.0


def test_impossible_speeds_exceed_the_limit():
    t = np.arange(200) / RATE
    path = np.stack([5 * t, 0 * t, 0 * t], 1)  # 5 metres a second
    limit = measure_speed_limit(path[:, None], RATE)
    np.testing.assert_allclose(limit.speed_m_s, 5 * MAX_SPEED_RATIO)
    assert not limit.is_exceeded(path, RATE)
    path[60] += [0.0, 0.9, 0.0]  # 90 metres a second
    assert limit.is_exceeded(path, RATE)


def test_nothing_is_too_fast_where_nothing_is_seen():
    assert not measure_speed_limit(np.full((5, 2, 3), np.nan), RATE).is_exceeded(np.array([[0.0, 0, 0], [9, 0, 0]]), RATE)
    assert measure_speed_limit(np.zeros((5, 0, 3)), RATE).speed_m_s == np.inf


def test_constant_velocity_does_not_vary_and_noise_counts_little():
    t = np.arange(400) / RATE
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=0.0003, size=(400, 3))
    markers = np.stack([np.stack([t, 0 * t, 0 * t], 1) + noise, np.stack([np.sin(6 * t), 0 * t, 0 * t], 1)], 1)
    variation = measure_velocity_variation(np.concatenate([markers, np.full((400, 1, 3), np.nan)], 1), RATE)
    assert variation[0] < 0.01
    np.testing.assert_allclose(variation[1], 6 / np.sqrt(2), rtol=0.1)
    np.testing.assert_allclose(variation[2], np.sqrt((variation[:2] ** 2).mean()))

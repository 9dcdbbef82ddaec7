"""The demo's table on paths with known errors."""

from dataclasses import dataclass

import numpy as np
import pytest

from mocapfix.model.take import Take
from mocapfix.synthetic import compute_fill_errors, compute_rms_error_mm, interpolate_markers


@dataclass
class Truth:
    """The fields of a synthetic take that the table needs."""

    marker_positions: np.ndarray
    damaged_positions: np.ndarray
    missing_mask: np.ndarray
    spike_mask: np.ndarray
    rate: float = 100.0


@dataclass
class Result:
    """The fields of a result that the table needs."""

    take: Take


def path(power):
    t = np.arange(200) / 100.0
    return (t[:, None, None] ** power) * np.array([[1.0, -2.0, 0.5]])


@pytest.mark.parametrize(("degree", "power"), [(1, 1), (3, 1), (3, 3)])
def test_interpolation_is_exact_for_polynomials_of_its_degree(degree, power):
    truth = path(power)
    damaged = truth.copy()
    damaged[50:120] = damaged[150:153] = np.nan
    np.testing.assert_allclose(interpolate_markers(damaged, degree), truth, atol=1e-9)


@pytest.mark.parametrize("degree", [1, 3])
def test_ends_repeat_the_nearest_sample_and_visible_samples_are_unchanged(degree):
    truth = path(2)
    damaged = truth.copy()
    damaged[:10] = damaged[190:] = damaged[100:105] = np.nan
    errors = interpolate_markers(damaged, degree)
    np.testing.assert_allclose(errors[:10], truth[[10] * 10], atol=1e-12)
    np.testing.assert_allclose(errors[190:], truth[[189] * 10], atol=1e-12)
    visible = ~np.isnan(damaged)
    np.testing.assert_array_equal(errors[visible], damaged[visible])
    assert np.isnan(damaged[:10]).all()  # the input is not modified


def test_marker_with_too_few_samples_is_not_filled():
    damaged = np.full((200, 2, 3), np.nan)
    damaged[[3, 50, 90, 120], 0] = 1.0
    assert np.isnan(interpolate_markers(damaged, 3)[~np.isin(np.arange(200), [3, 50, 90, 120])]).all()


def test_errors_are_root_mean_squares_by_damage():
    truth = np.zeros((200, 8, 3))
    missing, spiked = np.zeros((200, 8), bool), np.zeros((200, 8), bool)
    missing[20:30, 0], missing[100:150, 1], missing[10:65, 2:], spiked[70:72, 0] = True, True, True, True
    damaged = np.where(missing[..., None], np.nan, truth)
    damaged[spiked] = [0.3, 0.4, 0.0]
    ours = truth.copy()
    ours[20:30, 0, 1] = np.tile([0.003, -0.004], 5)
    ours[100:150, 1] = [0.0, 0.02, 0.0]
    ours[10:65, 2:, 0] = 0.05
    ours[70, 0, 2] = 0.001
    after = Take(ours, tuple("ABCDEFGH"), 100.0)
    errors = compute_fill_errors(Truth(truth, damaged, missing, spiked), Result(after))  # pyright: ignore[reportArgumentType]
    assert list(errors) == ["linear", "cubic", "mocapfix"]
    assert list(errors["mocapfix"].values()) == pytest.approx([np.sqrt(12.5), 20.0, 50.0, np.sqrt(0.5)])
    named = ["gaps under 0.5 s", "one marker lost for 0.5 s and more", "a whole arm lost", "spikes"]
    assert list(errors["mocapfix"]) == list(errors["linear"]) == named
    assert errors["linear"]["one marker lost for 0.5 s and more"] == pytest.approx(0.0, abs=1e-9)
    assert errors["linear"]["spikes"] == errors["cubic"]["spikes"] == pytest.approx(500.0)  # interpolation does not change spikes


def test_rms_uses_samples_in_the_mask_only():
    truth, mask = np.zeros((4, 1, 3)), np.array([[True], [True], [False], [False]])
    markers = np.array([[[0.003, 0, 0.004]], [[0, 0, 0]], [[9, 9, 9]], [[np.nan] * 3]])
    truth_take = Truth(truth, truth, mask, mask)
    assert compute_rms_error_mm(markers, truth_take, mask) == pytest.approx(np.sqrt(12.5))  # pyright: ignore[reportArgumentType]

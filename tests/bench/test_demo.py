"""The demo's table, on courses whose errors are known."""

from dataclasses import dataclass

import numpy as np
import pytest

from mocapfix.bench.demo import compute_fill_errors, compute_rms_error_mm, interpolate_markers
from mocapfix.take import Take


@dataclass
class Known:
    """As much of a truth, and of a result, as the table looks at."""

    markers: np.ndarray
    damaged: np.ndarray
    struck: np.ndarray
    moved: np.ndarray
    rate: float = 100.0


@dataclass
class Found:
    take: Take


def path(power):
    t = np.arange(200) / 100.0
    return (t[:, None, None] ** power) * np.array([[1.0, -2.0, 0.5]])


@pytest.mark.parametrize(("degree", "power"), [(1, 1), (3, 1), (3, 3)])
def test_interpolation_is_exact_on_its_own_curves(degree, power):
    truth = path(power)
    torn = truth.copy()
    torn[50:120] = torn[150:153] = np.nan
    np.testing.assert_allclose(interpolate_markers(torn, degree), truth, atol=1e-9)


@pytest.mark.parametrize("degree", [1, 3])
def test_the_ends_are_held_and_what_was_seen_stays(degree):
    truth = path(2)
    torn = truth.copy()
    torn[:10] = torn[190:] = torn[100:105] = np.nan
    found = interpolate_markers(torn, degree)
    np.testing.assert_allclose(found[:10], truth[[10] * 10], atol=1e-12)
    np.testing.assert_allclose(found[190:], truth[[189] * 10], atol=1e-12)
    seen = ~np.isnan(torn)
    np.testing.assert_array_equal(found[seen], torn[seen])
    assert np.isnan(torn[:10]).all()  # what was given is not written into


def test_a_marker_with_too_few_samples_stays_empty():
    torn = np.full((200, 2, 3), np.nan)
    torn[[3, 50, 90, 120], 0] = 1.0
    assert np.isnan(interpolate_markers(torn, 3)[~np.isin(np.arange(200), [3, 50, 90, 120])]).all()


def test_errors_are_sorted_by_damage_and_rooted_mean_squares():
    truth = np.zeros((200, 8, 3))
    struck, moved = np.zeros((200, 8), bool), np.zeros((200, 8), bool)
    struck[20:30, 0], struck[100:150, 1], struck[10:65, 2:], moved[70:72, 0] = True, True, True, True
    damaged = np.where(struck[..., None], np.nan, truth)
    damaged[moved] = [0.3, 0.4, 0.0]
    ours = truth.copy()
    ours[20:30, 0, 1] = np.tile([0.003, -0.004], 5)
    ours[100:150, 1] = [0.0, 0.02, 0.0]
    ours[10:65, 2:, 0] = 0.05
    ours[70, 0, 2] = 0.001
    after = Take(ours, tuple("ABCDEFGH"), 100.0)
    found = compute_fill_errors(Known(truth, damaged, struck, moved), Found(after))  # pyright: ignore[reportArgumentType]
    assert list(found) == ["linear", "cubic", "mocapfix"]
    assert list(found["mocapfix"].values()) == pytest.approx([np.sqrt(12.5), 20.0, 50.0, np.sqrt(0.5)])
    named = ["gaps under 0.5 s", "one marker lost for 0.5 s and more", "a whole arm lost", "spikes"]
    assert list(found["mocapfix"]) == list(found["linear"]) == named
    assert found["linear"]["one marker lost for 0.5 s and more"] == pytest.approx(0.0, abs=1e-9)
    assert found["linear"]["spikes"] == found["cubic"]["spikes"] == pytest.approx(500.0)  # they believe what they are given


def test_rms_looks_only_where_it_is_asked():
    truth, where = np.zeros((4, 1, 3)), np.array([[True], [True], [False], [False]])
    markers = np.array([[[0.003, 0, 0.004]], [[0, 0, 0]], [[9, 9, 9]], [[np.nan] * 3]])
    known = Known(truth, truth, where, where)
    assert compute_rms_error_mm(markers, known, where) == pytest.approx(np.sqrt(12.5))  # pyright: ignore[reportArgumentType]

import tracemalloc

import numpy as np
import pytest

from mocapfix.stats import point_function_search
from mocapfix.stats.point_function_search import (
    compare_points,
    find_exactly_rigid_points,
    find_point_functions,
    measure_distance_sd,
)
from mocapfix.stats.point_functions import PointFunction, build_frame_axes

FRAMES = 300
SKIN_SD_M = 0.001
RESOLUTION_M = 4e-7


def build_segment(seed: int, count: int = 6, skin_sd_m: float = SKIN_SD_M) -> np.ndarray:
    """Return markers (T, M, 3) on a segment that turns and travels, each with slow motion of its own on the skin."""
    random = np.random.default_rng(seed)
    time = np.linspace(0, 3, FRAMES)
    angle, tilt = 0.8 * np.sin(time), 0.4 * np.sin(1.7 * time)
    turn = np.zeros((FRAMES, 3, 3))
    turn[:, 0, 0], turn[:, 0, 2], turn[:, 2, 0], turn[:, 2, 2], turn[:, 1, 1] = (
        *(np.cos(angle), np.sin(angle)),
        *(
            -np.sin(angle),
            np.cos(angle),
        ),
        1,
    )
    lean = np.zeros_like(turn)
    lean[:, 0, 0], lean[:, 0, 1], lean[:, 1, 0], lean[:, 1, 1], lean[:, 2, 2] = (
        *(np.cos(tilt), -np.sin(tilt)),
        *(
            np.sin(tilt),
            np.cos(tilt),
        ),
        1,
    )
    shape = random.normal(scale=0.1, size=(count, 3))
    waves = random.normal(size=(4, count, 3)) * skin_sd_m / 2
    skin = np.einsum("kt,kmx->tmx", np.sin(np.arange(1, 5)[:, None] * time + random.uniform(0, 6, (4, 1))), waves)
    travel = np.stack([time, 1 + 0.05 * np.sin(5 * time), 0.1 * time], -1)
    return np.einsum("tij,tmj->tmi", turn @ lean, shape + skin) + travel[:, None]


def find(points: np.ndarray, resolution_m: float = RESOLUTION_M) -> dict[int, PointFunction]:
    is_visible = np.any(~np.isnan(points[..., 0]), axis=0)
    return find_point_functions(points, resolution_m, is_visible, is_visible)


def as_floats(points: np.ndarray) -> np.ndarray:
    """Return positions as a file of 32-bit floats in millimetres stores them."""
    return (points * 1000).astype(np.float32) / 1000.0


def compute_hip_centre(points: np.ndarray) -> np.ndarray:
    """Return a joint centre in the frame of two front markers and the midpoint of two others."""
    back = points[:, 2:4].mean(1)
    axes = build_frame_axes(np.stack([points[:, 0], points[:, 1], back], 1))
    return points[:, :2].mean(1) + np.einsum("i,tix->tx", [0.03, -0.08, -0.05], axes)


FUNCTIONS = {
    "a midpoint": (lambda points: points[:, :2].mean(1), {0, 1}),
    "a point between two": (lambda points: 0.3 * points[:, 1] + 0.7 * points[:, 4], {1, 4}),
    "a mean of four": (lambda points: points[:, :4].mean(1), {0, 1, 2, 3}),
    "a joint centre": (compute_hip_centre, {0, 1, 2, 3}),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_of_markers_are_found(name):
    function, parents = FUNCTIONS[name]
    markers = build_segment(3, 5)
    points = as_floats(np.concatenate([markers, function(markers)[:, None]], axis=1))
    found = find(points)
    assert list(found) == [5]
    assert set(found[5].parents) == parents
    # It holds for other positions of the parents too.
    other = build_segment(3, 5, 2 * SKIN_SD_M)
    np.testing.assert_allclose(found[5].evaluate(other[:, list(found[5].parents)]), function(other), atol=2e-5)


def test_functions_are_found_despite_gaps_and_faults():
    markers = build_segment(3, 5)
    points = as_floats(np.concatenate([markers, compute_hip_centre(markers)[:, None]], axis=1))
    points[40:60, 0] = np.nan
    points[100:110, 1] += 0.2
    points[150:160, 5] += 0.1
    assert list(find(points)) == [5]


@pytest.mark.parametrize("noise_m", [1e-4, 2e-5])
def test_measured_markers_are_no_functions(noise_m):
    random = np.random.default_rng(1)
    points = np.concatenate([build_segment(seed, 5, skin_sd_m) for seed, skin_sd_m in ((1, 0.002), (2, 0.0), (3, 0.005))], axis=1)
    assert not find(as_floats(points + random.normal(scale=noise_m, size=points.shape)))


def test_markers_of_a_solved_take_are_no_functions_and_not_set_aside():
    points = as_floats(np.concatenate([build_segment(seed, 6, 0.0) for seed in (1, 2)], axis=1))
    assert not find(points)
    assert not find_exactly_rigid_points(points, RESOLUTION_M).any()


def test_a_copy_of_a_marker_is_kept():
    markers = as_floats(build_segment(4))
    assert not find(np.concatenate([markers, markers[:, :1]], axis=1))


def test_landmarks_with_exact_distances_are_functions_of_the_measured_markers_alone():
    markers = build_segment(5, 5)
    axes = build_frame_axes(markers[:, :3])
    landmarks = [markers[:, 0] + np.einsum("i,tix->tx", offset, axes) for offset in ([0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1])]
    points = as_floats(np.concatenate([*(landmark[:, None] for landmark in landmarks), markers], axis=1))
    found = find(points)
    assert sorted(found) == [0, 1, 2]
    assert all(set(function.parents) <= {3, 4, 5, 6, 7} for function in found.values())


def test_a_point_at_rest_is_not_judged():
    points = np.tile(build_segment(6)[:1], (FRAMES, 1, 1))
    points = np.concatenate([points, points[:, :2].mean(1, keepdims=True)], axis=1)
    assert not find(as_floats(points))
    assert not find(points[:5])


@pytest.mark.parametrize("count", [41, 300])
@pytest.mark.parametrize("resolution_m", [1e-6, 1e-3, 0.03, 0.1])
def test_fits_to_noise_and_to_rigid_points_are_few(count, resolution_m, monkeypatch):
    fits: list[int] = []
    regress = point_function_search._FunctionSearch._regress

    def count_fit(self, target, basis):
        fits.append(len(target))
        return regress(self, target, basis)

    monkeypatch.setattr(point_function_search._FunctionSearch, "_regress", count_fit)
    random = np.random.default_rng(count)
    noise = random.normal(size=(FRAMES, count, 3))
    path = np.cumsum(random.normal(scale=0.02, size=(FRAMES, 1, 3)), axis=0)
    for points in (noise, path + noise[:1]):
        fits.clear()
        assert not find(np.round(points / resolution_m) * resolution_m, resolution_m)
        assert len(fits) <= 2 * point_function_search.MAX_FAILED_FITS + point_function_search.MAX_FULL_FITS


def test_a_search_that_fails_too_often_ends(monkeypatch):
    markers = build_segment(3, 5)
    points = as_floats(np.concatenate([markers, markers[:, :2].mean(1, keepdims=True)], axis=1))
    assert list(find(points)) == [5]
    monkeypatch.setattr(point_function_search, "MAX_FAILED_FITS", 0)
    assert not find(points)


def test_many_points_are_compared_with_those_near_them(monkeypatch):
    segments = [build_segment(seed, 5) + [3.0 * seed, 0, 0] for seed in range(6)]
    points = np.concatenate([each for markers in segments for each in (markers, compute_hip_centre(markers)[:, None])], axis=1)
    points = as_floats(np.concatenate([points, np.full((FRAMES, 1, 3), np.nan)], axis=1))
    expected = find(points)
    assert sorted(expected) == [5, 11, 17, 23, 29, 35]
    sd_m = measure_distance_sd(points)
    monkeypatch.setattr(point_function_search, "MAX_COMPARED_PAIRS", 37 * 9)
    compared = compare_points(points)
    assert compared.partner.shape == (37, 9)
    rows = np.arange(37)[:, None]
    np.testing.assert_array_equal(compared.sd_m, sd_m[rows, compared.partner])
    assert (np.diff(compared.partner, axis=1) > 0).all()
    found = find(points)
    assert {point: each.parents for point, each in found.items()} == {point: each.parents for point, each in expected.items()}


def test_memory_does_not_grow_with_the_frames_of_all_pairs():
    points = np.random.default_rng(0).normal(size=(240, 600, 3))
    find(points[:, :10])  # compiles
    tracemalloc.start()
    try:
        find(points)
        assert tracemalloc.get_traced_memory()[1] < 60e6  # the distances of all pairs in all frames have 2 GB
    finally:
        tracemalloc.stop()

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.faults import Fault, MarkerShift
from mocapfix.report.change_curves import (
    CURVE_MARGIN_S,
    MAX_CURVE_POINTS,
    MAX_LABEL_CURVE_DURATION_S,
    _select_frames,
    build_change_curves,
)


def find_fault(scene, kind, marker=None):
    return next(f for f in scene.comparison.faults.items if f.kind == kind and marker in (None, f.marker))


def find_values(curves, kind, rank=0):
    (found,) = (curve for curve in curves.curves if (curve.kind, curve.rank) == (kind, rank))
    return found.values_mm


def is_known(values):
    return np.isfinite(values).all(axis=1)


def test_a_gap_is_shown_with_half_a_second_on_both_sides(scene):
    curves = build_change_curves(scene.comparison, find_fault(scene, "gap", 3))
    assert (curves.frames[0], curves.frames[-1]) == (0, 50 + 49 + 60)
    now, kept = find_values(curves, "now"), find_values(curves, "kept")
    inside = (curves.frames >= 50) & (curves.frames < 100)
    np.testing.assert_array_equal(is_known(now), np.isin(curves.frames, np.arange(49, 101)))  # to the adjacent samples
    np.testing.assert_array_equal(is_known(kept), ~inside)


def test_positions_are_relative_to_the_nearest_markers_in_millimetres(scene):
    curves, after = build_change_curves(scene.comparison, find_fault(scene, "gap", 3)), scene.comparison.cleaned_take
    references = [after.labels.index(label) for label in curves.reference_labels]
    assert len(references) == 3
    expected = 1e3 * (after.markers[:, 3] - after.markers[:, references].mean(axis=1))[curves.frames]
    now, kept = find_values(curves, "now"), find_values(curves, "kept")
    np.testing.assert_allclose(np.where(np.isfinite(now), now, kept), expected, atol=1e-9)
    assert np.ptp(expected, axis=0).max() < 1e-6  # though the body walks


def test_band_is_two_standard_deviations_around_estimated_samples(scene):
    curves = build_change_curves(scene.comparison, find_fault(scene, "gap", 3))
    inside = (curves.frames >= 50) & (curves.frames < 100)
    np.testing.assert_allclose(curves.band_mm[inside, :, 1] - curves.band_mm[inside, :, 0], 40.0)
    np.testing.assert_allclose(curves.band_mm[inside].mean(axis=-1), find_values(curves, "now")[inside], atol=1e-9)
    assert np.isnan(curves.band_mm[~inside]).all()


def test_both_markers_of_a_swap_are_shown_before_and_after(scene):
    curves = build_change_curves(scene.comparison, find_fault(scene, "swap"))
    inside = (curves.frames >= 150) & (curves.frames < 170)
    for one, other in ((0, 1), (1, 0)):
        np.testing.assert_allclose(find_values(curves, "was", one)[inside], find_values(curves, "now", other)[inside])
    assert np.isnan(curves.band_mm).all()


def test_a_fragment_is_shown_under_its_previous_label(scene):
    curves = build_change_curves(scene.comparison, find_fault(scene, "fragment"))
    inside = (curves.frames >= 20) & (curves.frames < 40)
    np.testing.assert_allclose(find_values(curves, "was", 1)[inside], find_values(curves, "now", 0)[inside])
    assert np.isnan(find_values(curves, "was", 0)[inside]).all()
    assert np.isnan(find_values(curves, "now", 1)[inside]).all()


def test_a_spike_of_one_sample_is_shown_also_in_a_fast_take(scene):
    frames = _select_frames(find_fault(scene, "spike"), scene.comparison.cleaned_take)
    assert {69, 70, 71} <= set(frames)
    fast = replace(scene.comparison.cleaned_take.replace_markers(np.zeros((40_000, 31, 3))), rate=2000.0)
    assert {69, 70, 71} <= set(_select_frames(find_fault(scene, "spike"), fast))
    assert len(_select_frames(find_fault(scene, "absent"), fast)) <= 2 * MAX_CURVE_POINTS


def test_a_shifted_marker_is_shown_by_its_distances_before_and_after(scene):
    fault = find_fault(scene, "moved")
    curves, after = build_change_curves(scene.comparison, fault), scene.comparison.cleaned_take
    neighbours = [after.labels.index(label) for label in curves.axis_names]
    was, now = find_values(curves, "was"), find_values(curves, "now")
    assert (is_known(was) == ((curves.frames < fault.first) & (curves.frames != 200))).all()
    distance_mm = 1e3 * np.linalg.norm(after.markers[:, neighbours] - after.markers[:, [20]], axis=-1)
    np.testing.assert_allclose(was[0], distance_mm[0])
    np.testing.assert_allclose(now[-1], distance_mm[-1])
    assert (abs(was[0] - now[-1]) > 3).all()  # the neighbours reveal the shift, though most markers are level with it


@pytest.mark.parametrize("settled", [210, 225])
def test_a_sliding_marker_has_a_curve_of_its_own_until_it_settles(scene, settled):
    curves = build_change_curves(scene.comparison, MarkerShift("drift", 20, 210, 239, 0.03, "", settled_frame=settled))
    sliding = (curves.frames >= 210) & (curves.frames < settled)
    assert (is_known(find_values(curves, "kept")) == sliding).all()
    assert (is_known(find_values(curves, "now")) == (curves.frames >= settled)).all()


def test_marker_missing_during_the_change_is_no_reference(scene):
    gap, after = find_fault(scene, "gap", 3), scene.comparison.cleaned_take
    nearest = after.labels.index(build_change_curves(scene.comparison, gap).reference_labels[0])
    markers = after.markers.copy()
    markers[70, nearest] = np.nan
    scene = scene.replace_comparison(cleaned_take=after.replace_markers(markers, after.sample_sd))
    assert after.labels[nearest] not in build_change_curves(scene.comparison, gap).reference_labels


def test_a_long_label_exchange_is_cut_and_at_most_three_markers_are_shown(scene):
    long = scene.comparison.cleaned_take.replace_markers(np.zeros((40_000, 31, 3)))
    frames = _select_frames(Fault("mislabelled", 1, 0, 39_999, 0.1, "", other_markers=(2,)), long)
    assert frames[-1] / long.rate == MAX_LABEL_CURVE_DURATION_S + CURVE_MARGIN_S
    segment_lost = Fault("segment lost", 1, 60, 80, 0.1, "", other_markers=(2, 3, 4, 6))
    curves = build_change_curves(scene.comparison, segment_lost)
    assert {curve.rank for curve in curves.curves} == {0, 1, 2}


def test_without_near_markers_positions_are_in_the_world(scene):
    after = scene.comparison.cleaned_take
    markers = after.markers.copy()
    markers[:, [m for m in range(31) if m != 3]] += 10.0 * np.arange(1, 31)[:, None]
    scene = scene.replace_comparison(cleaned_take=after.replace_markers(markers, after.sample_sd))
    curves = build_change_curves(scene.comparison, find_fault(scene, "gap", 3))
    assert curves.reference_labels == ()
    inside = (curves.frames >= 50) & (curves.frames < 100)
    np.testing.assert_allclose(find_values(curves, "now")[inside], 1e3 * markers[curves.frames[inside], 3])

"""Curves of changes, and their figures."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model import changes
from mocapfix.model.faults import Fault, Faults, MarkerShift
from mocapfix.model.take import Take
from mocapfix.report.change_figures import (
    CHANGE_FIGURE_HEIGHT,
    CHANGE_FIGURE_WIDTH,
    CURVE_MARGIN_S,
    MAX_CHANGE_FIGURES,
    MAX_CURVE_POINTS,
    MAX_LABEL_CURVE_DURATION_S,
    ChangeCurves,
    MarkerCurve,
    _select_frames,
    build_change_curves,
    draw_change_figure,
    select_worst_changes,
)

NO_BAND = np.full((5, 3, 2), np.nan)


def build_curves(*curves, band_mm=NO_BAND):
    return ChangeCurves(np.arange(10, 15), ("x", "y", "z"), (), curves, band_mm)


def parse_points(svg, css_class):
    (d,) = re.findall(rf'<path class="{css_class}[^"]*" d="([^"]*)"', svg)
    return [tuple(map(float, point)) for point in re.findall(r"(-?[\d.]+) (-?[\d.]+)", d)]


def test_axes_have_one_scale_and_larger_values_are_higher():
    values = np.zeros((5, 3))
    values[:, 0], values[:, 1] = [0, 100, 0, 0, 0], [0, 0, 0, 50, 0]
    svg = draw_change_figure(build_curves(MarkerCurve("now", values)), 11, 13, 1)
    points = np.array(parse_points(svg, "now")).reshape(3, 5, 2)
    x, y = points[..., 0], points[..., 1]
    assert (x == np.linspace(0, CHANGE_FIGURE_WIDTH, 5)).all()
    assert y[0, 1] == 0
    assert np.isclose((y[0, 0] - y[0, 1]) / (y[1, 0] - y[1, 3]), 2, atol=0.01)
    assert y[0].max() < y[1].min() < y[1].max() < y[2].min() <= CHANGE_FIGURE_HEIGHT


def test_a_single_sample_is_a_dot_and_an_empty_curve_is_not_drawn():
    values = np.full((5, 3), np.nan)
    values[2] = 1.0
    svg = draw_change_figure(build_curves(MarkerCurve("was", values)), 12, 12, 1)
    assert svg.count("h0") == 3
    assert len(parse_points(svg, "was")) == 3
    assert 'class="now' not in draw_change_figure(build_curves(MarkerCurve("now", np.full((5, 3), np.nan))), 12, 12, 1)


def test_the_interval_of_the_change_is_marked_with_the_files_frame_numbers():
    curves = build_curves(MarkerCurve("now", np.zeros((5, 3))))
    svg = draw_change_figure(curves, 11, 13, 101)
    assert [text for text in re.findall(r">([^<>]+)</text>", svg) if text.isdigit()] == ["112", "114"]
    assert ">113</text>" in draw_change_figure(curves, 12, 12, 101)
    ((left, width),) = re.findall(r'<rect class="when" x="([\d.]+)" y="-4" width="([\d.]+)"', svg)
    assert (float(left), float(width)) == (CHANGE_FIGURE_WIDTH / 4 - 1, CHANGE_FIGURE_WIDTH / 2 + 2)


def test_axis_names_are_escaped():
    curve = MarkerCurve("now", np.zeros((2, 1)))
    curves = ChangeCurves(np.arange(2), ("<b>",), (), (curve,), np.full((2, 1, 2), np.nan))
    assert "&lt;b&gt;" in draw_change_figure(curves, 0, 1, 1)


@given(st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=15, max_size=15), st.floats(0, 1e4))
def test_everything_is_inside_the_figure(values, half_width):
    values_mm = np.reshape(values, (5, 3))
    band_mm = np.stack([values_mm - half_width, values_mm + half_width], axis=-1)
    svg = draw_change_figure(build_curves(MarkerCurve("now", values_mm), band_mm=band_mm), 11, 13, 1)
    assert "nan" not in svg
    drawn = [point for d in re.findall(r' d="([^"]*)"', svg) for point in re.findall(r"(-?[\d.]+) (-?[\d.]+)", d)]
    assert all(0 <= float(x) <= CHANGE_FIGURE_WIDTH + 5 and -0.1 <= float(y) <= CHANGE_FIGURE_HEIGHT + 0.1 for x, y in drawn)


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


def build_long_take(scene):
    take = scene.comparison.cleaned_take
    return Take(np.zeros((40_000, 31, 3)), take.labels, take.rate, take.first_frame)


def test_a_spike_of_one_sample_is_shown_also_in_a_fast_take(scene):
    frames = _select_frames(find_fault(scene, "spike"), scene.comparison.cleaned_take)
    assert {69, 70, 71} <= set(frames)
    fast = replace(build_long_take(scene), rate=2000.0)
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
    long = build_long_take(scene)
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


def test_worst_changes_come_first_and_include_every_kind(scene):
    comparison = scene.comparison
    jitter = tuple(Fault("jitter", m, 10, 20 + m, 0.05, "") for m in range(8, 28))
    short = (Fault("spike", 5, 70, 70, 0.3, ""), Fault("spike", 5, 71, 71, 0.2, ""), Fault("stuck", 6, 3, 5, 0.01, ""))
    faults = (*short, *jitter)
    markers = comparison.cleaned_take.markers.copy()
    for fault in faults:
        markers[fault.frame_slice, fault.marker] += 0.001
    cleaned_take = comparison.cleaned_take.replace_markers(markers, None)
    methods = np.full((240, 31), "", object)
    made = changes.build_changes(comparison.input_take, comparison.relabelled_take, cleaned_take, faults, None, methods)
    fields = {"cleaned_take": cleaned_take, "faults": Faults(faults), "changes": tuple(change for change, _ in made)}
    selected = select_worst_changes(scene.replace_comparison(**fields).comparison)
    assert len(selected) == MAX_CHANGE_FIGURES
    assert [(c.kind, c.markers[0]) for c, _ in selected[:3]] == [("jitter", "M27"), ("jitter", "M26"), ("jitter", "M25")]
    assert [(c.kind, c.first) for c, _ in selected[-3:]] == [("spike", 171), ("spike", 172), ("stuck", 104)]  # all events
    assert all(change.first == comparison.input_take.get_frame_number(fault.first) for change, fault in selected)


def test_gaps_are_sorted_by_duration_and_uncertainty_not_by_travelled_distance(scene):
    first, second = scene.comparison.changes[0], scene.comparison.changes[-1]
    assert (first.markers, second.markers) == (("M03",), ("<b>&\"'",))
    gaps = [c.id for c, _ in select_worst_changes(scene.comparison) if c.kind == "gap"]
    assert gaps == [first.id, second.id]  # 0.42 s before 0.17 s
    uncertain = (first, *scene.comparison.changes[1:-1], replace(second, predicted_mm=100.0))
    worst = select_worst_changes(scene.replace_comparison(changes=uncertain).comparison)
    assert [c.id for c, _ in worst if c.kind == "gap"] == [second.id, first.id]


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_declined_changes_are_not_selected(scene, decision):
    declined = tuple(replace(change, decision=decision) for change in scene.comparison.changes)
    assert select_worst_changes(scene.replace_comparison(changes=declined).comparison) == []

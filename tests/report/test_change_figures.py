import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.report.change_curves import ChangeCurves, MarkerCurve
from mocapfix.report.change_figures import CHANGE_FIGURE_HEIGHT, CHANGE_FIGURE_WIDTH, draw_change_figure

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

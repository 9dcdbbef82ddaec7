import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.report.change_curves import ChangeCurves, MarkerCurve
from mocapfix.report.change_figures import CHANGE_FIGURE_HEIGHT, CHANGE_FIGURE_WIDTH, draw_change_figure

NONE = np.full((5, 3, 2), np.nan)


def shown(*paths, band=NONE):
    return ChangeCurves(np.arange(10, 15), ("x", "y", "z"), (), paths, band)


def points(svg, name):
    (d,) = re.findall(rf'<path class="{name}[^"]*" d="([^"]*)"', svg)
    return [tuple(map(float, point)) for point in re.findall(r"(-?[\d.]+) (-?[\d.]+)", d)]


def test_paths_are_on_one_scale_and_up_is_up():
    values = np.zeros((5, 3))
    values[:, 0], values[:, 1] = [0, 100, 0, 0, 0], [0, 0, 0, 50, 0]
    placed = np.array(points(draw_change_figure(shown(MarkerCurve("now", values)), 11, 13, 1), "now")).reshape(3, 5, 2)
    x, y = placed[..., 0], placed[..., 1]
    assert (x == np.linspace(0, CHANGE_FIGURE_WIDTH, 5)).all()
    assert y[0, 1] == 0
    assert np.isclose((y[0, 0] - y[0, 1]) / (y[1, 0] - y[1, 3]), 2, atol=0.01)
    assert y[0].max() < y[1].min() < y[1].max() < y[2].min() <= CHANGE_FIGURE_HEIGHT


def test_a_lone_sample_is_a_dot_and_nothing_else_is_drawn_of_a_path():
    values = np.full((5, 3), np.nan)
    values[2] = 1.0
    svg = draw_change_figure(shown(MarkerCurve("was", values)), 12, 12, 1)
    assert svg.count("h0") == 3
    assert len(points(svg, "was")) == 3
    assert 'class="now' not in draw_change_figure(shown(MarkerCurve("now", np.full((5, 3), np.nan))), 12, 12, 1)


def test_the_change_is_marked_and_numbered_as_in_the_file():
    svg = draw_change_figure(shown(MarkerCurve("now", np.zeros((5, 3)))), 11, 13, 101)
    assert [text for text in re.findall(r">([^<>]+)</text>", svg) if text.isdigit()] == ["112", "114"]
    assert ">113</text>" in draw_change_figure(shown(MarkerCurve("now", np.zeros((5, 3)))), 12, 12, 101)
    ((left, width),) = re.findall(r'<rect class="when" x="([\d.]+)" y="-4" width="([\d.]+)"', svg)
    assert (float(left), float(width)) == (CHANGE_FIGURE_WIDTH / 4 - 1, CHANGE_FIGURE_WIDTH / 2 + 2)


def test_names_are_escaped():
    curves = ChangeCurves(np.arange(2), ("<b>",), (), (MarkerCurve("now", np.zeros((2, 1))),), np.full((2, 1, 2), np.nan))
    assert "&lt;b&gt;" in draw_change_figure(curves, 0, 1, 1)


@given(st.lists(st.floats(-1e6, 1e6) | st.just(np.nan), min_size=15, max_size=15), st.floats(0, 1e4))
def test_everything_is_within_the_picture(values, wide):
    now = np.reshape(values, (5, 3))
    svg = draw_change_figure(shown(MarkerCurve("now", now), band=np.stack([now - wide, now + wide], axis=-1)), 11, 13, 1)
    assert "nan" not in svg
    drawn = [point for d in re.findall(r' d="([^"]*)"', svg) for point in re.findall(r"(-?[\d.]+) (-?[\d.]+)", d)]
    assert all(0 <= float(x) <= CHANGE_FIGURE_WIDTH + 5 and -0.1 <= float(y) <= CHANGE_FIGURE_HEIGHT + 0.1 for x, y in drawn)

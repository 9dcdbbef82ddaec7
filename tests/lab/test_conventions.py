"""Captures in all axes and units: what the measurement counts, on a synthetic person."""

from mocapfix.io.capture import read_take
from mocapfix.lab.conventions import AXIS_PERMUTATIONS, WRONG, clean_in_other_axes, count_outcomes
from mocapfix.synthetic import compose_take, write_synthetic_take


def test_outcomes_of_a_synthetic_take(tmp_path):
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, compose_take(seconds=2.0, rate=60.0))
    counts = count_outcomes(read_take(path))
    assert len(AXIS_PERMUTATIONS) == 48
    assert counts.right_handed["right"] + counts.right_handed["refused"] == 24 * 4
    assert counts.right_handed["right"] >= 24 * 2
    assert counts.left_handed == {"refused": 24 * 4}
    assert counts.mirrored["right"] == counts.right_handed["right"]
    assert counts.units == {"right": 6}
    assert WRONG not in counts.right_handed + counts.mirrored


def test_cleans_in_other_axes_are_the_same_or_refused(tmp_path):
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, compose_take(seconds=1.0, rate=60.0))
    assert clean_in_other_axes(path, 2) == {"right": 1, "refused": 1}

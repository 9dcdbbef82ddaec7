import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mocapfix.io.source_file import format_rows

FINITE = st.floats(allow_nan=False, allow_infinity=False)
HALVES = st.builds(lambda whole, bits: whole / 2**bits, st.integers(-(10**6), 10**6), st.integers(0, 20))
NEAR_HALVES = st.builds(lambda whole: (whole + 0.5) / 1e6, st.integers(-(10**9), 10**9))


def format_with_python(values, decimals):
    return "".join(" ".join(f"{x:.{decimals}f}" for x in row) + "\n" for row in values).encode()


@given(st.lists(st.one_of(FINITE, HALVES, NEAR_HALVES), min_size=1, max_size=40), st.integers(0, 15))
@example([-0.0, 0.0, -1e-9, 0.5, 1.5, 2.5, 0.125, 0.375, 1e22, 5e-324], 2)
@example([0.5, 1.5, 2.5, 3.5, -0.5, 4503599627370495.5], 0)
def test_rows_equal_those_of_python(numbers, decimals):
    assert format_rows(np.array([numbers]), decimals) == format_with_python([numbers], decimals)


@given(st.lists(st.one_of(st.floats(-4e9, 4e9), HALVES, NEAR_HALVES), min_size=1, max_size=300))
def test_rows_of_usual_numbers_equal_those_of_python(numbers):
    assert format_rows(np.array([numbers]), 6) == format_with_python([numbers], 6)


def test_numbers_are_separated_by_blanks_and_rows_by_line_feeds():
    assert format_rows(np.array([[1.0, -2.5], [3.25, 4.0]]), 1) == b"1.0 -2.5\n3.2 4.0\n"
    assert format_rows(np.empty((2, 0)), 6) == b"\n\n"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    with pytest.raises(ValueError, match="not finite"):
        format_rows(np.array([[1.0, bad]]), 6)

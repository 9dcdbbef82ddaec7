import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.io.coordinates import METRES_PER_UNIT, get_metres_per_unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [("mete", "m"), ("mill", "mm"), ("milli", "mm"), ("Centim", "cm"), ("inch", "in"), ("Inches", "in"), ("foot", "ft"),
     ("METRES ", "m"), ("mm", "mm"), ("MM.", "mm")],
)  # fmt: skip
def test_a_name_of_a_unit_may_be_cut_off(name, unit):
    assert get_metres_per_unit(name) == METRES_PER_UNIT[unit]


@given(st.text(max_size=12))
def test_other_texts_are_no_unit(text):
    known = ("mm", "cm", "m", "in", "ft", "mil", "cen", "met", "mtr", "inc", "foo", "fee")
    if not text.strip().lower().startswith(known):
        assert get_metres_per_unit(text) is None


@pytest.mark.parametrize("name", ["me", "mi", "furlong", "metric", "inchworm", ""])
def test_a_name_that_is_too_short_or_goes_on_otherwise_is_no_unit(name):
    assert get_metres_per_unit(name) is None

import pytest

from mocapfix.errors import ReadError
from mocapfix.io.coordinates import METRES_PER_UNIT
from mocapfix.io.file_content import parse_document
from mocapfix.io.marker_table import infer_number_format, parse_unit, parse_whole_number


@pytest.mark.parametrize(
    ("present", "unit", "number_format"),
    [
        (["1.25", "1046.47", "3"], "mm", ".2f"),
        (["1", "20"], "mm", ".2f"),  # at least 0.01 mm
        (["1.25"], "m", ".5f"),
        (["1.123456789012"], "m", ".9f"),
        (["1.5e-03", "2.25E+01"], "mm", ".6e"),
        (["1.5e-03", "22.5", "1.25"], "mm", ".2f"),
        ([], "cm", ".3f"),
    ],
)
def test_the_number_format_has_the_decimals_of_the_file(present, unit, number_format):
    assert infer_number_format(present, [], METRES_PER_UNIT[unit])[0] == number_format


@pytest.mark.parametrize(
    ("missing", "missing_text"), [([], ""), (["", ""], ""), (["NaN", "", "NaN"], "NaN"), (["0.000"], "0.000")]
)
def test_the_missing_text_is_the_most_frequent_one(missing, missing_text):
    assert infer_number_format(["1.0"], missing, 0.001)[1] == missing_text


@pytest.mark.parametrize(
    ("name", "metres"), [("Millimetres", 0.001), (" cm ", 0.01), ("Feet", 0.3048), ("IN", 0.0254), ("inches", 0.0254)]
)
def test_units(tmp_path, name, metres):
    assert parse_unit(parse_document(tmp_path, b"units"), 0, name) == metres


def test_an_unknown_unit_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(ReadError, match="line 1: the unit is 'deg'; give it with --unit, one of mm, cm, m, in, ft"):
        parse_unit(parse_document(tmp_path / "walk.trc", b"units"), 0, "deg")


@pytest.mark.parametrize(("text", "number"), [("128", 128), (" 12.0", 12), ("1,5", 1), ("", None), ("1e999", None)])
def test_whole_numbers(text, number):
    assert parse_whole_number(text) == number

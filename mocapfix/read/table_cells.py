"""Cells of a text table: numbers, missing values, units, rates, and the number format of the file.

This is not left to a library: the available ones (kineticstoolkit, pyomeca, trc-data-reader) depend on pandas, report
neither the line of an error nor the spelling of missing values, and lose the place of each number, which a patched copy of
the file needs.
"""

import re
from collections.abc import Iterator, Sequence
from math import ceil, log10
from operator import itemgetter

import numpy as np
from jaxtyping import Float, Int

from mocapfix.read.coordinates import METRES_PER_UNIT, get_metres_per_unit
from mocapfix.read.file_content import NOT_A_NUMBER_PATTERN, TextDocument
from mocapfix.read.frame_rate import parse_time

MISSING_TEXTS = {"", "n/a", "na", "null", "none", "-", "--"}  # in lower case
DECIMAL_COMMA_PATTERN = re.compile(r"\d,\d")
CELL_PADDING = ' \t"'  # characters around the text of a cell
MAX_INSPECTED_LINES = 200  # lines from which number formats are inferred
WRITTEN_RESOLUTION_M = 1e-5  # least resolution of a written coordinate
MIN_SPLIT_NUMBER_RATIO = 1.5  # of fields to columns, if decimal commas split numbers in two
MAX_TABLE_DECIMALS = 9  # of a written coordinate
MIN_EXPONENT_DECIMALS = 6  # of a coordinate written with an exponent


def find_nonblank_lines(document: TextDocument, start: int, delimiter: str) -> Iterator[int]:
    """Yield the indices of the lines from `start` on that have any content."""
    blank = delimiter + " \t\r"
    return (i for i in range(start, len(document.lines)) if document.lines[i].strip(blank))


def parse_fields(
    document: TextDocument,
    line_indices: Sequence[int],
    delimiter: str,
    decimal_sign: str,
    field_indices: Int[np.ndarray, " F"],
) -> Float[np.ndarray, "T F"]:
    """Return the numbers in F fields of T lines, NaN where a number is missing or the line ends before the field.

    Raises:
        ReadError: If a field is not a number. The message names line and field.
    """
    wanted, numbers = field_indices.tolist(), np.empty((len(line_indices), len(field_indices)))
    select = itemgetter(*wanted) if len(wanted) > 1 else lambda cells: (cells[wanted[0]],)
    width = max(wanted) + 1
    for t, index in enumerate(line_indices):
        cells = split_fields(document.get_line(index), delimiter, decimal_sign)
        cells += [""] * (width - len(cells))
        try:
            numbers[t] = [float(cell) if cell else np.nan for cell in select(cells)]
        except ValueError:
            numbers[t] = [_parse_field(document, index, field, cells[field]) for field in wanted]
    return numbers


def _parse_field(document: TextDocument, index: int, field: int, cell: str) -> float:
    text = cell.strip(CELL_PADDING)
    if text.lower() in MISSING_TEXTS or NOT_A_NUMBER_PATTERN.fullmatch(text):
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        raise document.build_error(index, f"field {field + 1} is {text[:20]!r} and not a number; export it again.") from error


def split_fields(line: str, delimiter: str, decimal_sign: str) -> list[str]:
    """Return the fields of a line, with decimal points."""
    return (line.replace(",", ".") if decimal_sign == "," else line).split(delimiter)


def detect_decimal_sign(document: TextDocument, line_indices: Sequence[int], delimiter: str) -> str:
    """Return "," if numbers are written with decimal commas and commas are not the delimiter, else "."."""
    inspected = (document.get_line(index) for index in line_indices[:MAX_INSPECTED_LINES])
    return "," if delimiter != "," and any(DECIMAL_COMMA_PATTERN.search(line) for line in inspected) else "."


def parse_whole_number(text: str) -> int | None:
    """Return the whole number in a header field, None if it has none."""
    try:
        return int(float(text.replace(",", ".")))
    except (ValueError, OverflowError):
        return None


def check_frame_count(declared: str, frame_count: int) -> tuple[str, ...]:
    """Return a note if the header field `declared` gives another number of frames than the file has."""
    if parse_whole_number(declared) in (None, frame_count):
        return ()
    return (f"The header declares {parse_whole_number(declared)} frames; the file has {frame_count}.",)


def parse_unit(document: TextDocument, index: int, name: str) -> float:
    """Return the metres in the unit that the line at `index` names.

    Raises:
        ReadError: If the unit is unknown. The message lists the known units.
    """
    if (unit_m := get_metres_per_unit(name)) is None:
        raise document.build_error(index, f"the unit is {name!r}; give it with --unit, one of {', '.join(METRES_PER_UNIT)}.")
    return unit_m


def parse_unit_or_default(document: TextDocument, index: int, name: str, default_unit: str) -> tuple[float, tuple[str, ...]]:
    """Return the metres in the unit that the line at `index` names, and a note if the default is used because it names none."""
    if name.strip():
        return parse_unit(document, index, name), ()
    return METRES_PER_UNIT[default_unit], (f"The header names no unit; {default_unit}, the usual one, is assumed.",)


def parse_times(document: TextDocument, line_indices: Sequence[int], delimiter: str, time_field: int) -> Float[np.ndarray, " T"]:
    """Return the times in one field of T lines as `parse_time` reads them, NaN where there is none."""
    cells = (document.get_line(index).split(delimiter, time_field + 1) for index in line_indices)
    texts = (line[time_field].strip(CELL_PADDING) if len(line) > time_field else "" for line in cells)
    return np.array([parse_time(text) if text else np.nan for text in texts], float)


def check_decimal_commas(document: TextDocument, line_indices: Sequence[int], delimiter: str, column_count: int) -> None:
    """Raise ReadError if numbers have decimal commas in a table with commas between its fields.

    Its lines have about twice as many fields as columns, and no points.
    """
    if delimiter != "," or not line_indices:
        return
    index = line_indices[0]
    line = document.get_line(index)
    if "." not in line and line.rstrip(", ").count(",") + 1 >= MIN_SPLIT_NUMBER_RATIO * column_count:
        problem = (
            f"has {line.count(',') + 1} fields for {column_count} columns: its decimal commas cannot be told from those between"
        )
        raise document.build_error(index, f"{problem}; export it with semicolons, tabs or decimal points.")


def infer_number_format(present: Sequence[str], missing: Sequence[str], unit_m: float) -> tuple[str, str]:
    """Infer how a file writes coordinates.

    Args:
        present: Cells with coordinates.
        missing: Cells of missing coordinates.
        unit_m: Metres per file unit.

    Returns:
        Format specification of a coordinate, as for `format`, and the text of a missing one. The format has as many decimals
        as the longest cell, and enough for 0.01 mm.
    """
    missing_text = max(sorted(set(missing)), key=missing.count) if missing else ""
    mantissas = [cell.lower().partition("e")[0] for cell in present]
    decimals = max((len(mantissa.partition(".")[2]) for mantissa in mantissas), default=0)
    if 2 * sum("e" in cell.lower() for cell in present) > len(present):
        return f".{max(decimals, MIN_EXPONENT_DECIMALS)}e", missing_text
    needed = ceil(log10(unit_m / WRITTEN_RESOLUTION_M) - 1e-9)
    return f".{min(max(decimals, needed), MAX_TABLE_DECIMALS)}f", missing_text

"""The cells of a text table: numbers, what is missing, units, rates, and how a file writes them.

Written out rather than left to a library, because those at hand (kineticstoolkit, pyomeca, trc-data-reader) stand on
pandas, know neither the line of a fault nor how a file spells what is missing, and lose where each number lay, which a
file that is to come back the same but for its mended samples needs.
"""

import re
from collections.abc import Iterator, Sequence
from operator import itemgetter

import numpy as np

from mocapfix.read.coordinates import METRES_PER_UNIT, get_metres_per_unit
from mocapfix.read.file_content import NOT_A_NUMBER_PATTERN, TextDocument

MISSING_TEXTS = {"", "n/a", "na", "null", "none", "-", "--"}
DECIMAL_COMMA_PATTERN = re.compile(r"\d,\d")
MAX_INSPECTED_LINES = 200  # lines, from which is told how a file writes its numbers
CELL_PADDING = ' \t"'  # a cell's number
MIN_DECIMALS_BY_UNIT = {0.001: 2, 0.01: 3, 1.0: 5, 0.0254: 4, 0.3048: 5}  # of a unit, that a hundredth of a millimetre takes
MAX_TABLE_DECIMALS = 9


def find_nonblank_lines(document: TextDocument, start: int, delimiter: str) -> Iterator[int]:
    """-> the indices of the lines from `start` on that hold anything."""
    blank = delimiter + " \t\r"
    return (i for i in range(start, len(document.lines)) if document.lines[i].strip(blank))


def parse_fields(
    document: TextDocument, line_indices: Sequence[int], delimiter: str, decimal_sign: str, field_indices: np.ndarray
) -> np.ndarray:
    """-> (T, F) floats of the `fields` (F,) of the lines `rows`, NaN where one is missing or the line ends before it.

    Raises ReadError naming line and field where one is no number.
    """
    wanted, out = field_indices.tolist(), np.empty((len(line_indices), len(field_indices)))
    chosen = itemgetter(*wanted) if len(wanted) > 1 else lambda cells: (cells[wanted[0]],)
    width = max(wanted) + 1
    for t, index in enumerate(line_indices):
        cells = split_fields(document.get_line(index), delimiter, decimal_sign)
        cells += [""] * (width - len(cells))
        try:
            out[t] = [float(cell) if cell else np.nan for cell in chosen(cells)]
        except ValueError:
            out[t] = [_parse_field(document, index, field, cells[field]) for field in wanted]
    return out


def _parse_field(document: TextDocument, index: int, field: int, cell: str) -> float:
    text = cell.strip(CELL_PADDING)
    if text.lower() in MISSING_TEXTS or NOT_A_NUMBER_PATTERN.fullmatch(text):
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        raise document.build_error(index, f"field {field + 1} is {text[:20]!r} and not a number; export it again.") from error


def split_fields(line: str, delimiter: str, decimal_sign: str) -> list[str]:
    """-> a line's fields, with decimal points."""
    return (line.replace(",", ".") if decimal_sign == "," else line).split(delimiter)


def detect_decimal_sign(document: TextDocument, line_indices: Sequence[int], delimiter: str) -> str:
    """-> "," where the numbers of a table that commas do not divide are written with them, as in much of Europe."""
    some = (document.get_line(index) for index in line_indices[:MAX_INSPECTED_LINES])
    return "," if delimiter != "," and any(DECIMAL_COMMA_PATTERN.search(line) for line in some) else "."


def parse_whole_number(text: str) -> int | None:
    """-> the whole number that a header says, None where it says none."""
    try:
        return int(float(text.replace(",", ".")))
    except (ValueError, OverflowError):
        return None


def check_frame_count(declared: str, frame_count: int) -> tuple[str, ...]:
    """-> what must be said where a header promises another number of frames than are there."""
    if parse_whole_number(declared) in (None, frame_count):
        return ()
    return (f"The header promises {parse_whole_number(declared)} frames and {frame_count} are there.",)


def parse_unit(document: TextDocument, index: int, name: str) -> float:
    """-> metres in the unit that the line at `index` names. Raises ReadError with the choices."""
    if (unit := get_metres_per_unit(name)) is None:
        raise document.build_error(index, f"the unit is {name!r}; set it to one of {', '.join(METRES_PER_UNIT)}.")
    return unit


def parse_unit_or_default(document: TextDocument, index: int, name: str, default_unit: str) -> tuple[float, tuple[str, ...]]:
    """-> metres in the unit that the line at `index` names, or in the `usual` one where it names none, which is remarked on."""
    if name.strip():
        return parse_unit(document, index, name), ()
    return METRES_PER_UNIT[default_unit], (f"The header names no unit; {default_unit} is taken, as is usual.",)


def parse_rate(
    document: TextDocument,
    index: int,
    rate_text: str,
    line_indices: Sequence[int] = (),
    delimiter: str = "",
    time_field: int = 0,
    time_unit_s: float = 1.0,
) -> float:
    """-> frames a second: what the line at `index` says or, where it says nothing, what the field `time` (in units of
    `seconds`) of the first and last of `rows` does.

    Raises ReadError where neither does.
    """
    try:
        rate = float(rate_text.replace(",", "."))
    except ValueError:
        rate = 0.0
    if np.isfinite(rate) and rate > 0:
        return rate
    if len(line_indices) > 1:
        ends = [line_indices[0], line_indices[-1]]
        first, last = parse_fields(document, ends, delimiter, "." if delimiter == "," else ",", np.array([time_field]))[:, 0]
        if last > first and (rate := round((len(line_indices) - 1) / (last - first) / time_unit_s, 3)) > 0:
            return rate
    what = f"the frame rate is {rate_text!r}" if rate_text else "nothing tells the frame rate"
    raise document.build_error(index, f"{what}; give the frames a second.")


def infer_number_format(present: Sequence[str], absent: Sequence[str], unit_m: float) -> tuple[str, str]:
    """-> how a file writes a coordinate, as in format(), and one that is missing, told from cells of both.

    A number gets as many decimals as the longest has, and enough for a hundredth of a millimetre.
    """
    missing = max(sorted(set(absent)), key=absent.count) if absent else ""
    mantissas = [cell.lower().partition("e")[0] for cell in present]
    digits = max((len(mantissa.partition(".")[2]) for mantissa in mantissas), default=0)
    if 2 * sum("e" in cell.lower() for cell in present) > len(present):
        return f".{max(digits, 6)}e", missing
    return f".{min(max(digits, MIN_DECIMALS_BY_UNIT[unit_m]), MAX_TABLE_DECIMALS)}f", missing

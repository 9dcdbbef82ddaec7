"""The cells of a text table: numbers, what is missing, units, rates, and how a file writes them.

Written out rather than left to a library, because those at hand (kineticstoolkit, pyomeca, trc-data-reader) stand on
pandas, know neither the line of a fault nor how a file spells what is missing, and lose where each number lay, which a
file that is to come back the same but for its mended samples needs.
"""

import re
from collections.abc import Iterator, Sequence
from operator import itemgetter

import numpy as np

from mocapfix.read.text import NO_NUMBER, Document
from mocapfix.read.units import METRES, metres

NOTHING = {"", "n/a", "na", "null", "none", "-", "--"}
DECIMAL_COMMA = re.compile(r"\d,\d")
LOOKED_AT = 200  # lines, from which is told how a file writes its numbers
AROUND = ' \t"'  # a cell's number
FEWEST_DECIMALS = {0.001: 2, 0.01: 3, 1.0: 5, 0.0254: 4, 0.3048: 5}  # of a unit, that a hundredth of a millimetre takes
MOST_DECIMALS = 9


def filled_rows(document: Document, start: int, delimiter: str) -> Iterator[int]:
    """-> the indices of the lines from `start` on that hold anything."""
    blank = delimiter + " \t\r"
    return (i for i in range(start, len(document.lines)) if document.lines[i].strip(blank))


def numbers(document: Document, rows: Sequence[int], delimiter: str, decimal: str, fields: np.ndarray) -> np.ndarray:
    """-> (T, F) floats of the `fields` (F,) of the lines `rows`, NaN where one is missing or the line ends before it.

    Raises ReadError naming line and field where one is no number.
    """
    wanted, out = fields.tolist(), np.empty((len(rows), len(fields)))
    chosen = itemgetter(*wanted) if len(wanted) > 1 else lambda cells: (cells[wanted[0]],)
    width = max(wanted) + 1
    for t, index in enumerate(rows):
        cells = split(document.line(index), delimiter, decimal)
        cells += [""] * (width - len(cells))
        try:
            out[t] = [float(cell) if cell else np.nan for cell in chosen(cells)]
        except ValueError:
            out[t] = [_number(document, index, field, cells[field]) for field in wanted]
    return out


def _number(document: Document, index: int, field: int, cell: str) -> float:
    text = cell.strip(AROUND)
    if text.lower() in NOTHING or NO_NUMBER.fullmatch(text):
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        raise document.fault(index, f"field {field + 1} is {text[:20]!r} and not a number; export it again.") from error


def split(line: str, delimiter: str, decimal: str) -> list[str]:
    """-> a line's fields, with decimal points."""
    return (line.replace(",", ".") if decimal == "," else line).split(delimiter)


def decimal_sign(document: Document, rows: Sequence[int], delimiter: str) -> str:
    """-> "," where the numbers of a table that commas do not divide are written with them, as in much of Europe."""
    some = (document.line(index) for index in rows[:LOOKED_AT])
    return "," if delimiter != "," and any(DECIMAL_COMMA.search(line) for line in some) else "."


def whole(text: str) -> int | None:
    """-> the whole number that a header says, None where it says none."""
    try:
        return int(float(text.replace(",", ".")))
    except (ValueError, OverflowError):
        return None


def miscounted(promised: str, frames: int) -> tuple[str, ...]:
    """-> what must be said where a header promises another number of frames than are there."""
    if whole(promised) in (None, frames):
        return ()
    return (f"The header promises {whole(promised)} frames and {frames} are there.",)


def unit_of(document: Document, index: int, name: str) -> float:
    """-> metres in the unit that the line at `index` names. Raises ReadError with the choices."""
    if (unit := metres(name)) is None:
        raise document.fault(index, f"the unit is {name!r}; set it to one of {', '.join(METRES)}.")
    return unit


def unit_said(document: Document, index: int, name: str, usual: str) -> tuple[float, tuple[str, ...]]:
    """-> metres in the unit that the line at `index` names, or in the `usual` one where it names none, which is remarked on."""
    if name.strip():
        return unit_of(document, index, name), ()
    return METRES[usual], (f"The header names no unit; {usual} is taken, as is usual.",)


def rate_of(
    document: Document,
    index: int,
    said: str,
    rows: Sequence[int] = (),
    delimiter: str = "",
    time: int = 0,
    seconds: float = 1.0,
) -> float:
    """-> frames a second: what the line at `index` says or, where it says nothing, what the field `time` (in units of
    `seconds`) of the first and last of `rows` does.

    Raises ReadError where neither does.
    """
    try:
        rate = float(said.replace(",", "."))
    except ValueError:
        rate = 0.0
    if np.isfinite(rate) and rate > 0:
        return rate
    if len(rows) > 1:
        ends = [rows[0], rows[-1]]
        first, last = numbers(document, ends, delimiter, "." if delimiter == "," else ",", np.array([time]))[:, 0]
        if last > first and (rate := round((len(rows) - 1) / (last - first) / seconds, 3)) > 0:
            return rate
    what = f"the frame rate is {said!r}" if said else "nothing tells the frame rate"
    raise document.fault(index, f"{what}; give the frames a second.")


def written(present: Sequence[str], absent: Sequence[str], unit: float) -> tuple[str, str]:
    """-> how a file writes a coordinate, as in format(), and one that is missing, told from cells of both.

    A number gets as many decimals as the longest has, and enough for a hundredth of a millimetre.
    """
    missing = max(sorted(set(absent)), key=absent.count) if absent else ""
    mantissas = [cell.lower().partition("e")[0] for cell in present]
    digits = max((len(mantissa.partition(".")[2]) for mantissa in mantissas), default=0)
    if 2 * sum("e" in cell.lower() for cell in present) > len(present):
        return f".{max(digits, 6)}e", missing
    return f".{min(max(digits, FEWEST_DECIMALS[unit]), MOST_DECIMALS)}f", missing

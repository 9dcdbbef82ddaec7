"""A table of trajectories, a line a frame and three fields a point: what all text formats of marker takes have in common.

Each format's own module says where the table lies and what its columns are; here the numbers are read and become a take.
Written out rather than left to a library, because those at hand (kineticstoolkit, pyomeca, trc-data-reader) stand on
pandas, know neither the line of a fault nor how a file spells what is missing, and lose where each number lay, which a
file that is to come back the same but for its mended samples needs.
"""

import re
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read.axes import to_y_up
from mocapfix.read.c3d import NOWHERE
from mocapfix.read.labels import marker_columns, unlabelled_columns
from mocapfix.read.text import Document
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# What a unit is called where it is written out, "Millimetres" or "Meters", without its plural.
SHORT = {"millimeter": "mm", "millimetre": "mm", "centimeter": "cm", "centimetre": "cm", "meter": "m", "metre": "m"}
SHORT |= {"inche": "in", "inch": "in", "feet": "ft"}
NOTHING = {"", "nan", "-nan", "+nan", "n/a", "na", "null", "none", "-", "--", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind"}
DECIMAL_COMMA = re.compile(r"\d,\d")
LOOKED_AT = 200  # lines, from which is told how a file writes its numbers
MOST_DECIMALS = 9


@dataclass(frozen=True)
class Sheet:
    """Where a table lies in a document, and what its columns are.

    rows     indices of its lines, a frame each
    frame    the field with the frame's number; None: counted from 1
    fields   (P, 3) the fields with each point's x, y and z
    labels   of the P points;  outputs  those of them that are listed as a model's
    unit     metres per file unit;  rate  frames a second
    vertical, usual  as read.axes.to_y_up takes them
    """

    document: Document
    delimiter: str
    rows: Sequence[int]
    frame: int | None
    fields: np.ndarray
    labels: Sequence[str]
    unit: float
    rate: float
    vertical: str = ""
    usual: str = "Z"
    outputs: AbstractSet[str] = frozenset()
    notes: tuple[str, ...] = ()


def take_of(sheet: Sheet) -> Take:
    """-> the take in a table: metres, Y up, NaN where a coordinate is blank, spelled as missing, or all three are 0.

    Raises ReadError, naming file and line, where a field is no number, frames do not follow one another, the last line is
    cut off, or no point is a labelled marker.
    """
    document, path = sheet.document, sheet.document.path
    if not len(sheet.rows):
        raise ReadError(f"{path}: holds no frames; export the trial again.")
    decimal = decimal_sign(sheet)
    check_end(sheet)
    raw = numbers(document, sheet.rows, sheet.delimiter, decimal, sheet.fields.ravel()).reshape(-1, len(sheet.fields), 3)
    seen = there(raw)
    labels = list(sheet.labels)
    columns = marker_columns(labels, sheet.outputs, seen, np.zeros(seen.shape))
    if not len(columns):
        raise ReadError(f"{path}: none of its {len(labels)} trajectories is a labelled marker; label them and export it again.")
    positions = np.where(seen[..., None], raw * sheet.unit, np.nan)
    names = tuple(labels[i] for i in columns)
    axes = to_y_up(sheet.vertical, names, positions[:, columns], sheet.usual)
    style, missing = written(sheet, decimal, seen)
    lines = np.asarray(sheet.rows, int)
    where = TableLayout(
        document.encoding, document.newline, sheet.delimiter, decimal, lines, sheet.fields, style, missing, sheet.unit, axes
    )
    first, said = first_frame(sheet)
    nameless = unlabelled_columns(labels, sheet.outputs, seen)
    unlabelled = Take(
        positions[:, nameless] @ axes.T, tuple(labels[i] for i in nameless), sheet.rate, first, path, columns=nameless
    )
    return Take(
        markers=positions[:, columns] @ axes.T,
        labels=names,
        rate=sheet.rate,
        first_frame=first,
        path=path,
        layout=where,
        columns=columns,
        others=tuple(label for i, label in enumerate(labels) if i not in set(columns)),
        unlabelled=unlabelled if len(nameless) else None,
        notes=(*sheet.notes, *said),
    )


def there(raw: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: is the point of `raw` (T, P, 3) file units a place? Neither missing, nor all 0, nor Cortex's 9999999."""
    return (np.abs(raw) < NOWHERE).all(-1) & (raw != 0).any(-1)


def numbers(document: Document, rows: Sequence[int], delimiter: str, decimal: str, fields: np.ndarray) -> np.ndarray:
    """-> (T, F) floats of the lines `rows`, NaN where a field is missing or the line ends before it.

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


def split(line: str, delimiter: str, decimal: str) -> list[str]:
    """-> a line's fields, with decimal points."""
    return (line.replace(",", ".") if decimal == "," else line).split(delimiter)


def _number(document: Document, index: int, field: int, cell: str) -> float:
    text = cell.strip(' \t"')
    if text.lower() in NOTHING:
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        raise document.fault(index, f"field {field + 1} is {text[:20]!r} and not a number; export it again.") from error


def decimal_sign(sheet: Sheet) -> str:
    """-> "," where the numbers of a table that commas do not divide are written with them, as in much of Europe."""
    some = (sheet.document.line(index) for index in sheet.rows[:LOOKED_AT])
    return "," if sheet.delimiter != "," and any(DECIMAL_COMMA.search(line) for line in some) else "."


def check_end(sheet: Sheet) -> None:
    """Raise ReadError where the last line ends within the table, as when a copy was cut off."""
    last, document = sheet.rows[-1], sheet.document
    needed = int(sheet.fields.max()) + 1
    there = len(document.line(last).split(sheet.delimiter))
    if last == len(document.lines) - 1 and there < needed:
        raise document.fault(last, f"is cut off: {there} fields are there and {needed} belong there; copy or export it again.")


def first_frame(sheet: Sheet) -> tuple[int, tuple[str, ...]]:
    """-> the file's number of its first frame, and what must be said of the others'.

    Raises ReadError naming the line where frames do not follow one another.
    """
    if sheet.frame is None:
        return 1, ()
    document = sheet.document
    count = numbers(document, sheet.rows, sheet.delimiter, "." if sheet.delimiter == "," else ",", np.array([sheet.frame]))[:, 0]
    if (odd := np.flatnonzero(~np.isfinite(count) | (count != np.rint(count)))).size:
        raise document.fault(sheet.rows[odd[0]], "does not begin with a frame's number; export it again.")
    steps = np.diff(count)
    step = steps[0] if len(steps) else 1.0
    if (odd := np.flatnonzero((steps != step) | (steps < 1))).size:
        t = odd[0]
        follows = f"frame {count[t + 1]:.0f} follows frame {count[t]:.0f}"
        raise document.fault(sheet.rows[t + 1], f"{follows}; export the trial whole.")
    first = int(count[0])
    if step == 1:
        return first, ()
    return first, (f"Only every {step:.0f}. frame is in the file; frames are counted on from {first} here.",)


def written(sheet: Sheet, decimal: str, seen: np.ndarray) -> tuple[str, str]:
    """-> how the table writes a coordinate, as in format(), and one that is missing, told from lines all through it."""
    present, absent = [], []
    for t in np.unique(np.linspace(0, len(sheet.rows) - 1, LOOKED_AT).astype(int)):
        cells = split(sheet.document.line(sheet.rows[t]), sheet.delimiter, decimal)
        for x, is_there in zip(sheet.fields[:, 0], seen[t], strict=True):
            if x < len(cells):
                (present if is_there else absent).append(cells[x].strip(' \t"'))
    missing = max(set(absent), key=absent.count) if absent else ""
    exponents = sum("e" in text.lower() for text in present)
    digits = max((len(text.lower().partition("e")[0].partition(".")[2]) for text in present), default=0)
    if 2 * exponents > len(present):
        return f".{max(digits, 6)}e", missing.replace(".", decimal)
    finest = int(np.ceil(np.log10(sheet.unit / 1e-5)))  # a hundredth of a millimetre, where no sample says more
    return f".{min(max(digits, finest if digits == 0 else digits), MOST_DECIMALS)}f", missing.replace(".", decimal)


def unit_of(document: Document, index: int, name: str) -> float:
    """-> metres in the unit that the line at `index` names. Raises ReadError with the choices."""
    plain = name.strip().lower().removesuffix("s")
    short = SHORT.get(plain, plain)
    if short not in METRES:
        raise document.fault(index, f"the unit is {name!r}; set it to one of {', '.join(METRES)}.")
    return METRES[short]


def rate_of(document: Document, index: int, said: str, rows: Sequence[int], delimiter: str, time: int) -> float:
    """-> frames a second: what the line at `index` says or, where it says nothing, what the field `time` (seconds) does.

    Raises ReadError where neither does.
    """
    try:
        rate = float(said.replace(",", "."))
    except ValueError:
        rate = 0.0
    if np.isfinite(rate) and rate > 0:
        return rate
    if len(rows) > 1:
        sign = "." if delimiter == "," else ","
        first, last = numbers(document, [rows[0], rows[-1]], delimiter, sign, np.array([time]))[:, 0]
        if last > first:
            return round((len(rows) - 1) / (last - first), 3)
    raise document.fault(index, f"the frame rate is {said!r}; set it to the frames a second.")


def filled_rows(document: Document, start: int, delimiter: str) -> Iterator[int]:
    """-> the indices of the lines from `start` on that hold anything."""
    blank = delimiter + " \t\r"
    return (i for i in range(start, len(document.lines)) if document.lines[i].strip(blank))

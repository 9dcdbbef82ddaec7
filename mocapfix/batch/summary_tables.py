"""The tables of a session, summary.csv and summary.parquet: one row for each subject of each take.

The columns do not depend on the takes, so that the tables of several sessions can be joined. What is not known is empty.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from mocapfix.batch.records import TakeRecord
from mocapfix.batch.take_figures import SubjectFigures
from mocapfix.faults import FaultKind
from mocapfix.files.output_files import replace_atomically

CSV_NAME = "summary.csv"
PARQUET_NAME = "summary.parquet"

SummaryValue = str | int | float | None
ColumnKind = Literal["string", "int64", "float64"]
"""type of a column, by its name in pyarrow"""


@dataclass(frozen=True)
class SummaryColumn:
    """A column: its name with the unit, the type of its values, and how they are found.

    `read_value` gets the record of a take and the figures of one subject, None for a take that failed.
    """

    name: str
    kind: ColumnKind
    read_value: Callable[[TakeRecord, SubjectFigures | None], SummaryValue]


def build_take_column(name: str, kind: ColumnKind) -> SummaryColumn:
    """Return a column of a field of the record."""
    return SummaryColumn(name, kind, lambda record, _: getattr(record, name))


def build_figure_column(name: str, kind: ColumnKind) -> SummaryColumn:
    """Return a column of a field of the figures."""
    return SummaryColumn(name, kind, lambda _, figures: getattr(figures, name) if figures else None)


def build_fault_column(kind: str) -> SummaryColumn:
    """Return the column of the number of faults of a kind, such as "fault_count_leading_gap"."""
    name = f"fault_count_{kind.replace(' ', '_')}"
    return SummaryColumn(name, "int64", lambda _, figures: figures.fault_counts.get(kind, 0) if figures else None)


SUMMARY_COLUMNS = (
    build_take_column("take", "string"),
    build_figure_column("subject", "string"),
    build_take_column("status", "string"),
    build_take_column("reason", "string"),
    build_take_column("error", "string"),
    build_figure_column("marker_set", "string"),
    build_figure_column("frame_count", "int64"),
    build_figure_column("rate_hz", "float64"),
    build_figure_column("duration_s", "float64"),
    build_figure_column("sample_count", "int64"),
    build_figure_column("missing_before", "int64"),
    build_figure_column("filled", "int64"),
    build_figure_column("replaced", "int64"),
    build_figure_column("relabelled", "int64"),
    build_figure_column("left_empty", "int64"),
    build_figure_column("worst_predicted_error_mm", "float64"),
    build_figure_column("worst_frame", "int64"),
    build_figure_column("residual_mm", "float64"),
    SummaryColumn("fault_count", "int64", lambda _, figures: sum(figures.fault_counts.values()) if figures else None),
    *(build_fault_column(kind) for kind in get_args(FaultKind)),
    SummaryColumn("take_seconds", "float64", lambda record, _: record.seconds),
    SummaryColumn("take_peak_memory_mb", "float64", lambda record, _: record.peak_memory_mb),
    build_take_column("attempts", "int64"),
    SummaryColumn("subject_file", "string", lambda record, each: record.subject_files.get(each.subject) if each else None),
    SummaryColumn("notes", "string", lambda _, figures: " ".join(figures.notes) if figures else None),
    build_take_column("input", "string"),
    build_take_column("input_sha256", "string"),
    build_take_column("options_sha256", "string"),
    build_take_column("version", "string"),
    build_take_column("started", "string"),
    build_take_column("finished", "string"),
)
"""the columns in their order; those that begin with "take_" hold for the take, and are repeated for each of its subjects"""


def list_summary_rows(records: Sequence[TakeRecord]) -> Iterator[tuple[TakeRecord, SubjectFigures | None]]:
    """Yield each record with each of its subjects, with None where there is none; failed takes first, then by take."""
    for record in sorted(records, key=lambda record: (record.status == "done", record.take)):
        for figures in record.subjects or (None,):
            yield record, figures


def write_summary_tables(folder: Path, records: Sequence[TakeRecord]) -> tuple[Path, Path]:
    """Write summary.csv and summary.parquet into a folder and return their paths. Raises WriteError."""
    import pyarrow as pa
    from pyarrow import parquet

    rows = list(list_summary_rows(records))
    values = {column.name: [column.read_value(*row) for row in rows] for column in SUMMARY_COLUMNS}
    csv_path, parquet_path = folder / CSV_NAME, folder / PARQUET_NAME
    with replace_atomically(csv_path) as part:
        part.write_text(format_csv(values), encoding="utf-8", newline="")
    schema = pa.schema([(column.name, getattr(pa, column.kind)()) for column in SUMMARY_COLUMNS])
    with replace_atomically(parquet_path) as part:
        parquet.write_table(pa.table(values, schema=schema), part)
    return csv_path, parquet_path


def format_csv(values: dict[str, list[SummaryValue]]) -> str:
    """Return a table as comma-separated values by RFC 4180, with a header; carriage returns in names are quoted too."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(values)
    writer.writerows(zip(*values.values(), strict=True))
    return text.getvalue()

"""The page of a session, index.html: totals, failed takes, people and all takes; and its tables, summary.csv and summary.parquet.

The page needs no network. A script in it sorts, filters and divides the table into pages; without the script the whole table is
shown. The tables have one row for each subject of each take. Their columns do not depend on the takes, so that the tables of
several sessions can be joined. What is not known is empty.
"""

import csv
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import quote

from markupsafe import Markup

from mocapfix.batch.records import PEOPLE_FILE_NAME, PersonEntry, SessionPeople, SubjectFigures, TakeRecord, read_people_file
from mocapfix.errors import SceneError, join_words
from mocapfix.io.files import replace_atomically
from mocapfix.model.faults import FaultKind
from mocapfix.model.system import make_file_name
from mocapfix.report.html_report import write_page
from mocapfix.report.terms import format_fault_counts, format_number

CSV_NAME = "summary.csv"
PARQUET_NAME = "summary.parquet"

ColumnKind = Literal["string", "int64", "float64"]  # type of a column, by its name in pyarrow
SUMMARY_COLUMNS: dict[str, ColumnKind] = {
    **dict.fromkeys(("take", "subject", "status", "reason", "error", "marker_set"), "string"),
    "frame_count": "int64", "rate_hz": "float64", "duration_s": "float64",
    **dict.fromkeys(("sample_count", "missing_before", "filled", "replaced", "relabelled", "left_empty"), "int64"),
    "worst_predicted_error_mm": "float64", "worst_frame": "int64", "residual_mm": "float64", "fault_count": "int64",
    **{f"fault_count_{kind.replace(' ', '_')}": "int64" for kind in get_args(FaultKind)},
    "take_seconds": "float64", "take_peak_memory_mb": "float64", "attempts": "int64",
    **dict.fromkeys(("subject_file", "notes", "input", "input_sha256", "options_sha256"), "string"),
    **dict.fromkeys(("version", "started", "finished"), "string"),
}  # fmt: skip
"""the columns in their order, and their types; those that begin with "take_" are repeated for each subject of a take"""


def list_summary_rows(records: Sequence[TakeRecord]) -> Iterator[tuple[TakeRecord, SubjectFigures | None]]:
    """Yield each record with each of its subjects, with None where there is none; failed takes first, then by take."""
    for record in sorted(records, key=lambda record: (record.status == "done", record.take)):
        for figures in record.subjects or (None,):
            yield record, figures


def build_summary_row(record: TakeRecord, figures: SubjectFigures | None) -> dict[str, str | int | float | None]:
    """Return the values of the columns for one subject of a take, None where they are unknown, as for a take that failed."""
    values = record.model_dump(exclude={"subjects"})
    values |= {"take_seconds": record.seconds, "take_peak_memory_mb": record.peak_memory_mb}
    if figures:
        values |= figures.model_dump(exclude={"picture_svg"})
        values |= {f"fault_count_{kind.replace(' ', '_')}": figures.fault_counts.get(kind, 0) for kind in get_args(FaultKind)}
        values |= {"fault_count": sum(figures.fault_counts.values()), "notes": " ".join(figures.notes)}
        values["subject_file"] = record.subject_files.get(figures.subject)
    return {name: values.get(name) for name in SUMMARY_COLUMNS}


def write_summary_tables(folder: Path, records: Sequence[TakeRecord]) -> tuple[Path, Path]:
    """Write summary.csv and summary.parquet into a folder and return their paths. Raises WriteError."""
    import pyarrow as pa
    from pyarrow import parquet

    rows = [build_summary_row(*row) for row in list_summary_rows(records)]
    csv_path, parquet_path = folder / CSV_NAME, folder / PARQUET_NAME
    with replace_atomically(csv_path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, SUMMARY_COLUMNS)  # by RFC 4180; carriage returns in names are quoted too
        writer.writeheader()
        writer.writerows(rows)
    schema = pa.schema([(name, getattr(pa, kind)()) for name, kind in SUMMARY_COLUMNS.items()])
    with replace_atomically(parquet_path) as part:
        parquet.write_table(pa.Table.from_pylist(rows, schema=schema), part)
    return csv_path, parquet_path


PAGE_NAME = "index.html"
PERCENT = 100
PICTURE_PATTERN = re.compile(
    r'<svg class="moment" viewBox="[-\d ]+" role="img"><title>[^<>]*</title>(<path class="[a-z ]+" d="[-LMhlm\d ]*"/>)*</svg>'
)
"""what a picture in a record may contain: anybody who can write into the batch's folder can change it"""


@dataclass(frozen=True)
class TakeRow:
    """One subject of a take. `numbers` has a text for each column of numbers before the faults; "–" if it is unknown."""

    take: str
    subject: str
    status: str
    status_text: str
    numbers: tuple[str, ...]
    faults: str
    picture: Markup
    report: str
    notes: tuple[str, ...]
    links: Mapping[str, str]


TAKE_COLUMNS = (
    "Take", "Subject", "Status", "Length,\u00a0s", "Missing before,\u00a0%", "Filled", "Replaced", "Relabelled", "Left empty",
    "Worst predicted error,\u00a0mm", "Residual,\u00a0mm", "Time,\u00a0s", "Faults",
)  # fmt: skip
"""columns of the table of takes that can be sorted: the first three as text, the others by numbers"""


def write_session_page(folder: Path, records: Sequence[TakeRecord], waiting_count: int = 0, title: str = "") -> Path:
    """Write index.html, summary.csv and summary.parquet into the folder of a batch and return the path of the page.

    The people are those in the folder's people.yaml, if there is one.

    Args:
        waiting_count: Takes that are still to be cleaned; with any the page loads itself again now and then.
        title: "" for the name of the folder.

    Raises:
        WriteError: If one of them cannot be written.
    """
    write_summary_tables(folder, records)
    script = files("mocapfix.report").joinpath("templates/session.js").read_text(encoding="utf-8")
    write_page(
        folder / PAGE_NAME,
        "session.html.jinja",
        title=title or folder.resolve().name,
        subtitle=describe_session(records),
        waiting_count=waiting_count,
        **build_session_page(records, waiting_count),
        **_read_people(folder),
        quote_address=quote_address,
        script=Markup(script),
        script_hash=b64encode(sha256(script.encode()).digest()).decode(),
    )
    return folder / PAGE_NAME


def _read_people(folder: Path) -> dict[str, Sequence[PersonEntry] | Sequence[str]]:
    """Return the people of a session and the notes on them, as the template has them."""
    try:
        people = read_people_file(folder) or SessionPeople()
    except SceneError as error:
        return {"people": [], "people_notes": [str(error)]}
    rejected = [f"{take} is not of {each.name}: {reason}" for each in people.people for take, reason in each.rejected.items()]
    return {"people": people.people, "people_notes": [*people.notes, *rejected]}


def describe_session(records: Sequence[TakeRecord]) -> str:
    """Return the line below the title: versions, and when the last take was finished."""
    versions = sorted({record.version for record in records if record.version})
    finished = max((record.finished for record in records), default="")
    parts = [f"Cleaned by mocapfix {join_words(versions)}"] if versions else []
    parts += [f"last take finished at {format_minute(finished)}"] if finished else []
    return f"{', '.join(parts)}." if parts else ""


def format_minute(time: str) -> str:
    """Return a time in ISO 8601 as "2026-11-23 20:05 UTC"; any other text as it is."""
    try:
        return f"{datetime.fromisoformat(time):%Y-%m-%d %H:%M %Z}".strip()
    except ValueError:
        return time


def build_session_page(records: Sequence[TakeRecord], waiting_count: int = 0) -> dict[str, Any]:
    """Return the values of the template that follow from the records."""
    failed = sorted((record for record in records if record.status == "failed"), key=lambda record: record.take)
    reasons = Counter(record.reason or "error" for record in failed)
    counts = join_words([f"{count:,} {reason}" for reason, count in sorted(reasons.items())])
    return {
        "facts": _build_session_facts(records, waiting_count),
        "failures": failed,
        "failure_text": f"{len(failed):,} failed: {counts}",
        "rows": [_build_take_row(record, figures) for record, figures in list_summary_rows(records)],
        "columns": TAKE_COLUMNS,
        "csv_name": CSV_NAME,
        "parquet_name": PARQUET_NAME,
        "people_name": PEOPLE_FILE_NAME,
    }


def _build_session_facts(records: Sequence[TakeRecord], waiting_count: int) -> list[tuple[str, str]]:
    """Return the totals: value and text."""
    done = [record for record in records if record.status == "done"]
    subjects = [figures for record in done for figures in record.subjects]
    samples = max(1, sum(figures.sample_count for figures in subjects))
    duration_s = sum(max((figures.duration_s for figures in record.subjects), default=0.0) for record in done)
    return [
        (f"{len(done):,}", f"of {len(records) + waiting_count:,} takes done"),
        (f"{len(records) - len(done):,}", "failed"),
        (_format_hours(duration_s), "of motion, h:min:s"),
        (f"{PERCENT * sum(figures.missing_before for figures in subjects) / samples:.1f} %", "of the samples missing before"),
        (f"{sum(figures.filled for figures in subjects):,}", "samples filled"),
        (f"{sum(figures.replaced for figures in subjects):,}", "faulty samples replaced"),
        (f"{sum(figures.left_empty for figures in subjects):,}", "samples left empty"),
        (_format_hours(sum(record.seconds for record in records)), "of computation, h:min:s"),
    ]


def _format_hours(duration_s: float) -> str:
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes // 60:,}:{minutes % 60:02d}:{seconds:02d}"


def _build_take_row(record: TakeRecord, figures: SubjectFigures | None) -> TakeRow:
    outputs = select_subject_outputs(record, figures.subject) if figures else {}
    links = {suffix: quote_address(path) for suffix, path in outputs.items()}
    fault_count = sum(figures.fault_counts.values()) if figures else 0
    kinds = f": {format_fault_counts(figures.fault_counts)}" if figures and fault_count else ""
    return TakeRow(
        take=record.take,
        subject=figures.subject if figures else "",
        status=record.status,
        status_text=record.status if record.reason is None else f"{record.status}: {record.reason}",
        numbers=(*_format_figures(figures), format_number(record.seconds)),
        faults=f"{fault_count:,}{kinds}" if figures else "–",
        picture=check_picture(figures.picture_svg if figures else ""),
        report=next((address for suffix, address in links.items() if suffix.endswith("report.html")), ""),
        notes=figures.notes if figures else (record.error,),
        links=links,
    )


def check_picture(svg: str) -> Markup:
    """Return the picture of a record for the page, nothing if it is not one that mocapfix draws."""
    return Markup(svg if PICTURE_PATTERN.fullmatch(svg) else "")


def _format_figures(figures: SubjectFigures | None) -> tuple[str, ...]:
    """Return the texts of the columns from the length to the residual."""
    if figures is None:
        return ("–",) * 8
    counts = (figures.filled, figures.replaced, figures.relabelled, figures.left_empty)
    return (
        format_number(figures.duration_s),
        format_number(PERCENT * figures.missing_before / max(1, figures.sample_count)),
        *(f"{count:,}" for count in counts),
        format_number(figures.worst_predicted_error_mm),
        format_number(figures.residual_mm),
    )


def select_subject_outputs(record: TakeRecord, subject: str) -> dict[str, str]:
    """Return the outputs of one subject and those of the whole take, by suffix.

    The suffixes of one of several subjects begin with its name, written as in file names.
    """
    names = {each.subject: make_file_name(each.subject) for each in record.subjects}
    owners = {
        suffix: max((name for name in names.values() if name and suffix.startswith(f"{name}.")), key=len, default="")
        for suffix in record.outputs
    }
    return {suffix: path for suffix, path in record.outputs.items() if owners[suffix] in ("", names.get(subject, ""))}


def quote_address(path: str) -> str:
    """Return the relative address of a file in the batch's folder, with everything quoted that an address cannot hold."""
    return quote(path.encode("utf-8", "surrogateescape"))

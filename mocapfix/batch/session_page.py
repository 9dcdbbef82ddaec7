"""The page of a session, index.html: totals, failed takes with their reasons, people, and a table of all takes.

The page needs no network. A script in it sorts, filters and divides the table into pages; without the script the whole table is
shown.

The tables of a session, summary.csv and summary.parquet: one row for each subject of each take.

The columns do not depend on the takes, so that the tables of several sessions can be joined. What is not known is empty.
"""

import csv
import io
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import quote

from markupsafe import Markup

from mocapfix.batch.records import TakeRecord
from mocapfix.batch.session_people import PEOPLE_FILE_NAME, PersonEntry, read_people_file
from mocapfix.batch.take_figures import SubjectFigures
from mocapfix.errors import SceneError, join_words
from mocapfix.io.files import replace_atomically
from mocapfix.model.faults import FaultKind
from mocapfix.report.html_report import write_page
from mocapfix.report.terms import format_kind_counts, format_number

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


PAGE_NAME = "index.html"
MAX_OPEN_FAILURES = 50
"""failed takes up to which their list is open"""
SECONDS_IN_HOUR = 3600
PERCENT = 100
REPORT_SUFFIX = "report.html"
PICTURE_PATTERN = re.compile(
    r'<svg class="moment" viewBox="[-\d ]+" role="img"><title>[^<>]*</title>(<path class="[a-z ]+" d="[-Mhlm\d ]*"/>)*</svg>'
)
"""what a picture in a record may contain: anybody who can write into the batch's folder can change it"""

Link = tuple[str, str]
"""text and address"""


@dataclass(frozen=True)
class PageColumn:
    """A column of the table of takes that can be sorted: by numbers, or as text."""

    title: str
    is_number: bool = True
    is_aligned_right: bool = True


@dataclass(frozen=True)
class FailureRow:
    """A take that failed."""

    take: str
    reason: str
    error: str
    attempts: int
    seconds: str


@dataclass(frozen=True)
class PersonRow:
    """A person of the session.

    basis  from what it is known which takes are of this person
    """

    name: str
    take_count: int
    basis: str
    takes: str
    moved_markers: str
    links: tuple[Link, ...] = ()


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
    links: tuple[Link, ...]

    @property
    def notes_title(self) -> str:
        """Such as "2 notes"."""
        return f"{len(self.notes)} note{'' if len(self.notes) == 1 else 's'}"


TAKE_COLUMNS = (
    PageColumn("Take", is_number=False, is_aligned_right=False),
    PageColumn("Subject", is_number=False, is_aligned_right=False),
    PageColumn("Status", is_number=False, is_aligned_right=False),
    PageColumn("Length,\u00a0s"),
    PageColumn("Missing before,\u00a0%"),
    PageColumn("Filled"),
    PageColumn("Replaced"),
    PageColumn("Relabelled"),
    PageColumn("Left empty"),
    PageColumn("Worst predicted error,\u00a0mm"),
    PageColumn("Residual,\u00a0mm"),
    PageColumn("Time,\u00a0s"),
    PageColumn("Faults", is_aligned_right=False),
)


@dataclass(frozen=True)
class SessionPage:
    """Values of the template."""

    facts: list[tuple[str, str]]
    failures: list[FailureRow]
    failure_text: str
    people: Sequence[PersonRow]
    people_notes: Sequence[str]
    rows: list[TakeRow]
    are_failures_open: bool
    columns: tuple[PageColumn, ...] = TAKE_COLUMNS
    csv_name: str = CSV_NAME
    parquet_name: str = PARQUET_NAME
    people_name: str = PEOPLE_FILE_NAME


def write_session_page(folder: Path, records: Sequence[TakeRecord], title: str = "") -> Path:
    """Write index.html, summary.csv and summary.parquet into the folder of a batch and return the path of the page.

    The people are those in the folder's people.yaml, if there is one.

    title  "" for the name of the folder

    Raises WriteError if one of them cannot be written.
    """
    write_summary_tables(folder, records)
    script = files("mocapfix.report").joinpath("templates/session.js").read_text(encoding="utf-8")
    write_page(
        folder / PAGE_NAME,
        "session.html.jinja",
        title=title or folder.resolve().name,
        subtitle=describe_session(records),
        page=build_session_page(records, *_read_people(folder)),
        script=Markup(script),
        script_hash=b64encode(sha256(script.encode()).digest()).decode(),
    )
    return folder / PAGE_NAME


def _read_people(folder: Path) -> tuple[list[PersonRow], list[str]]:
    """Return the rows of people and the notes on them."""
    try:
        people = read_people_file(folder)
    except SceneError as error:
        return [], [str(error)]
    if people is None:
        return [], []
    rejected = [f"{take} is not of {each.name}: {reason}" for each in people.people for take, reason in each.rejected.items()]
    return [build_person_row(each) for each in people.people], [*people.notes, *rejected]


def build_person_row(person: PersonEntry) -> PersonRow:
    """Return the row of a person, with links to the subject files."""
    takes = [f"{take} ({subject})" if subject else take for take, subject in person.takes.items()]
    files = dict.fromkeys(path for path in (person.subject_file, *person.take_files.values()) if path)
    links = tuple((path.rpartition("/")[2], quote_address(path)) for path in files)
    moved = " ".join(person.moved_markers) or "none"
    return PersonRow(person.name, len(takes), person.basis or "takes", ", ".join(takes), moved, links)


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


def build_session_page(
    records: Sequence[TakeRecord], people: Sequence[PersonRow] = (), people_notes: Sequence[str] = ()
) -> SessionPage:
    """Return the values of the template."""
    failed = sorted((record for record in records if record.status == "failed"), key=lambda record: record.take)
    reasons = Counter(record.reason or "error" for record in failed)
    counts = join_words([f"{count:,} {reason}" for reason, count in sorted(reasons.items())])
    return SessionPage(
        facts=_build_session_facts(records),
        failures=[FailureRow(r.take, r.reason or "error", r.error, r.attempts, format_number(r.seconds)) for r in failed],
        failure_text=f"{len(failed):,} failed: {counts}",
        people=people,
        people_notes=people_notes,
        rows=[_build_take_row(record, figures) for record, figures in list_summary_rows(records)],
        are_failures_open=len(failed) <= MAX_OPEN_FAILURES,
    )


def _build_session_facts(records: Sequence[TakeRecord]) -> list[tuple[str, str]]:
    """Return the totals: value and text."""
    done = [record for record in records if record.status == "done"]
    subjects = [figures for record in done for figures in record.subjects]
    samples = max(1, sum(figures.sample_count for figures in subjects))
    duration_s = sum(max((figures.duration_s for figures in record.subjects), default=0.0) for record in done)
    return [
        (f"{len(done):,}", f"of {len(records):,} takes done"),
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
    outputs = select_subject_outputs(record, figures.subject if figures else "")
    links = {suffix: quote_address(path) for suffix, path in outputs.items()}
    report = next((address for suffix, address in links.items() if suffix.endswith(REPORT_SUFFIX)), "")
    return TakeRow(
        take=record.take,
        subject=figures.subject if figures else "",
        status=record.status,
        status_text=record.status if record.reason is None else f"{record.status}: {record.reason}",
        numbers=(*_format_figures(figures), format_number(record.seconds)),
        faults=_format_faults(figures.fault_counts) if figures else "–",
        picture=check_picture(figures.picture_svg if figures else ""),
        report=report,
        notes=figures.notes if figures else (record.error,),
        links=tuple(links.items()),
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


def _format_faults(counts: Mapping[str, int]) -> str:
    """Return the number of faults, by which the column is sorted, and what they are."""
    total = sum(counts.values())
    return f"{total:,}" + (f": {format_kind_counts(counts)}" if total else "")


def select_subject_outputs(record: TakeRecord, subject: str) -> dict[str, str]:
    """Return the outputs of one subject and those of the whole take, by suffix.

    The suffixes of one of several subjects begin with its name, written as in file names.
    """
    names = {each.subject: re.sub(r"[^\w. -]", "_", each.subject) for each in record.subjects}
    owners = {
        suffix: max((name for name in names.values() if name and suffix.startswith(f"{name}.")), key=len, default="")
        for suffix in record.outputs
    }
    return {suffix: path for suffix, path in record.outputs.items() if owners[suffix] in ("", names.get(subject, ""))}


def quote_address(path: str) -> str:
    """Return the relative address of a file in the batch's folder, with everything quoted that an address cannot hold."""
    return quote(path.encode("utf-8", "surrogateescape"))

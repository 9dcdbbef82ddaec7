"""The page of a session, index.html: totals, failed takes with their reasons, people, and a table of all takes.

The page needs no network. A script in it sorts, filters and divides the table into pages; without the script the whole table is
shown.
"""

import re
from base64 import b64encode
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from mocapfix.batch.people_file import PEOPLE_FILE_NAME, PersonEntry, read_people_file
from mocapfix.batch.records import TakeRecord
from mocapfix.batch.summary_tables import CSV_NAME, PARQUET_NAME, list_summary_rows, write_summary_tables
from mocapfix.batch.take_figures import SubjectFigures
from mocapfix.errors import SceneError, join_words
from mocapfix.report.html_page import write_page
from mocapfix.report.terms import format_kind_counts, format_number

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

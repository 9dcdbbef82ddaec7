"""The command `mocapfix batch`: clean all takes of a session on the cores of this machine or on a cluster.

The progress of a batch on the terminal: a bar with the jobs that are done, failed and at workers, and the time left.

In a pipe or a log file, a line at most every few seconds takes the place of the bar.
"""

import shlex
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn

from mocapfix.batch.cluster import BatchProgress
from mocapfix.cli import console
from mocapfix.cli.clean import describe_laboratory
from mocapfix.cli.commands import FlagOption, build_options_argument, describe_option, parse_options
from mocapfix.errors import MocapfixError, describe_error
from mocapfix.option import split_names
from mocapfix.options import CleanOptions

SESSION_SUFFIXES = (".yaml", ".yml")
if TYPE_CHECKING:
    from mocapfix.batch.job_files import Session
    from mocapfix.batch.records import TakeRecord


@dataclass(frozen=True)
class RunArguments:
    """Workers, limits and what is repeated."""

    workers: Annotated[int | None, describe_option("N", "worker processes, or Slurm jobs", "one a core")] = None
    scheduler: Annotated[str | None, describe_option("ADDRESS", "use the Dask scheduler that runs there", "none")] = None
    slurm: Annotated[
        FlagOption, tyro.conf.arg(help="start the workers as Slurm jobs (jobqueue.slurm of Dask's configuration)")
    ] = False
    ssh: Annotated[str, tyro.conf.arg(metavar="HOST,...", help="start the workers on these computers over SSH")] = ""
    timeout: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="end a take after this time")] = 3600.0
    memory: Annotated[float, tyro.conf.arg(metavar="MB", help="end a take that needs more memory")] = 4000.0
    retries: Annotated[int, tyro.conf.arg(metavar="N", help="repeat a take whose process crashed, this often")] = 1
    repeat_failed: Annotated[FlagOption, tyro.conf.arg(help="clean takes that failed again, although nothing changed")] = False
    people: Annotated[
        Literal["session", "memory", "each-take"],
        tyro.conf.arg(
            help="calibrate each person from all takes, infer lost limbs from the person's other takes besides (memory), "
            "or use each take alone"
        ),
    ] = "session"
    resume: Annotated[bool, tyro.conf.arg(help="skip takes that are done and unchanged")] = True

    def find_problem(self) -> str:
        """Return what is wrong with the arguments; "" if they are allowed."""
        if sum((self.scheduler is not None, self.slurm, bool(self.ssh))) > 1:
            return "Give one of --scheduler, --slurm and --ssh."
        if self.workers is not None and self.workers < 1:
            return f"--workers must be at least 1, not {self.workers}."
        if not self.timeout > 0:
            return f"--timeout must be greater than 0 s, not {self.timeout:g}."
        if not self.memory > 0:
            return f"--memory must be greater than 0 MB, not {self.memory:g}."
        return f"--retries must be at least 0, not {self.retries}." if self.retries < 0 else ""


DEFAULT_RUN = RunArguments()


def run_batch(
    takes: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="FOLDER|PATTERN|SESSION.yaml", help="the takes", help_behavior_hint="(at least one)"),
    ],
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for outputs and records")
    ],
    options: Annotated[object, build_options_argument(without=("review_files",))],
    run: Annotated[tyro.conf.OmitArgPrefixes[RunArguments], tyro.conf.arg(name="")] = DEFAULT_RUN,
) -> int:
    """Clean all takes of a session, on all cores or on a cluster, and write a page on them.

    Takes are cleaned in processes with limits of time and memory. Takes that fail do not stop the others. An interrupted batch
    goes on where it was.
    """
    from mocapfix.output_formats import list_output_formats

    if not takes:
        return console.print_usage_error("batch: name a folder, a pattern or a session file.")
    if problem := run.find_problem():
        return console.print_usage_error(problem)
    parsed = parse_options(options)
    try:
        list_output_formats(parsed.output)
    except MocapfixError as error:
        return console.print_usage_error(describe_error(error))

    from mocapfix.batch.cluster import ClusterOptions, check_dask_installed

    cluster = ClusterOptions(run.workers, run.scheduler, run.slurm, split_names([run.ssh]))
    check_dask_installed(cluster)
    from mocapfix.batch.child_process import JobLimits
    from mocapfix.batch.job_files import read_session_file
    from mocapfix.batch.run_session import BatchSettings, knows_people, run_session
    from mocapfix.batch.session_page import write_session_page
    from mocapfix.subject.library import load_requested_subject

    is_session = len(takes) == 1 and Path(takes[0]).suffix.lower() in SESSION_SUFFIXES
    if is_session and parsed != CleanOptions():
        return console.print_usage_error("With a session file the options of cleaning are in that file.")
    session = read_session_file(Path(takes[0])) if is_session else list_session(takes, output_folder, parsed)
    load_requested_subject(session.options.subject)  # a name that is wrong is so for all takes
    settings = BatchSettings(
        output_folder,
        session.options,
        JobLimits(run.timeout, run.memory, run.retries),
        cluster,
        run.resume,
        run.repeat_failed,
        each_take_alone=run.people == "each-take",
        remembers_people=run.people == "memory",
        people=session.people,
    )
    if settings.remembers_people and not knows_people(settings):
        return console.print_usage_error("--people memory cannot be used with --subject, --like, --subject-prefix or --fast.")
    if run.scheduler is None and not run.slurm and not run.ssh:
        console.compile_kernels_first(lambda text: None)
    with show_batch_progress() as progress:
        records = run_session(session.takes, settings, progress, partial(write_session_page, title=session.title))
    return print_outcome(records, progress.shown_failures, output_folder, session.options)


def list_session(names: Sequence[str], output_folder: Path, options: CleanOptions) -> "Session":
    """Return the takes in folders and patterns as a session, and print which files are left out."""
    from mocapfix.batch.job_files import Session, find_takes

    listed = find_takes(names, output_folder)
    for path in listed.unreadable:
        console.print_error(f"{path}: cannot be read, so its takes are not cleaned; check its permissions.")
    for path in listed.skipped:
        console.print_line(f"{escape(str(path))}: not cleaned, since a file beside it with another suffix is the take.")
    return Session("", listed.takes, {}, options)


def print_outcome(
    records: "Sequence[TakeRecord]", shown_failures: Mapping[str, str], output_folder: Path, options: CleanOptions
) -> int:
    """Print what became of the takes, with the failures that were not shown yet; return the exit status."""
    from mocapfix.batch.session_page import PAGE_NAME

    failed = [record for record in records if record.status == "failed"]
    for record in failed:
        if record.take not in shown_failures:
            console.print_error(f"{record.take} failed in an earlier batch (--repeat-failed cleans it again): {record.error}")
    console.print_line(
        f"{len(records) - len(failed):,} of {len(records):,} takes are done, {len(failed):,} failed. "
        f"Page: {escape(str(output_folder / PAGE_NAME))}"
    )
    laboratory = {record.take: next((each.laboratory for each in record.subjects if each.laboratory), "") for record in records}
    if note := describe_laboratory(laboratory, options):
        console.print_line(escape(note))
    if len(failed) < len(records):
        console.print_line(f"To look at the changes in the browser: mocapfix review {escape(shlex.quote(str(output_folder)))}")
    return console.EXIT_FAILED if failed else console.EXIT_DONE


MAX_SHOWN_JOBS = 3  # running jobs that are named beside the bar
MAX_JOB_NAME_LENGTH = 32  # letters of a job's name beside the bar; of longer names the end is shown
MIN_LINE_INTERVAL_S = 10.0  # time between two lines where there is no terminal
REFRESH_RATE_HZ = 4.0  # how often the bar is drawn
SECONDS_IN_MINUTE = 60
MINUTES_IN_HOUR = 60


@dataclass
class StageCounts:
    """The jobs of one stage.

    Attributes:
        running: The jobs that were handed to a worker and run or wait there, the earliest first.
    """

    stage: str = ""
    job_count: int = 0  # all jobs
    earlier_count: int = 0  # jobs that an earlier batch did
    start_s: float = 0.0  # time at which the stage began
    done_count: int = 0
    failed_count: int = 0
    running: dict[str, None] = field(default_factory=dict[str, None])

    @property
    def ended_count(self) -> int:
        """Jobs that are done or failed, with those of an earlier batch."""
        return self.earlier_count + self.done_count + self.failed_count

    def estimate_seconds_left(self, now_s: float) -> float | None:
        """Return the time that the other jobs will take at the rate of those that ended; None before the first has ended."""
        ended = self.done_count + self.failed_count
        return (now_s - self.start_s) / ended * (self.job_count - self.ended_count) if ended else None

    def describe(self, now_s: float) -> str:
        """Return a text such as "12 of 200 done, 1 failed, 4 at workers, about 5 min left"."""
        parts = [f"{self.earlier_count + self.done_count:,} of {self.job_count:,} done"]
        parts += [f"{self.failed_count:,} failed"] if self.failed_count else []
        parts += [f"{len(self.running):,} at workers"] if self.running else []
        left_s = self.estimate_seconds_left(now_s)
        parts += [f"about {format_duration(left_s)} left"] if left_s and self.ended_count < self.job_count else []
        return ", ".join(parts)


def format_duration(duration_s: float) -> str:
    """Return a duration in its two largest units, such as "2 h 5 min", "12 min" or "40 s"."""
    minutes = round(duration_s / SECONDS_IN_MINUTE)
    if minutes >= MINUTES_IN_HOUR:
        return f"{minutes // MINUTES_IN_HOUR:,} h {minutes % MINUTES_IN_HOUR} min"
    return f"{minutes} min" if duration_s >= 2 * SECONDS_IN_MINUTE else f"{round(duration_s)} s"


class PlainProgress(BatchProgress):
    """Progress as lines: failures and messages at once, the counts at most every ten seconds and at the end of a stage.

    Attributes:
        shown_failures: The sentences that were printed, by name of the job. A take that fails for the same reason in two stages,
            when it is surveyed and when it is cleaned, is printed once.
    """

    def __init__(self, console: Console = console.stderr_console, read_clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._read_clock = console, read_clock
        self._counts = StageCounts()
        self._last_line_s = 0.0
        self.shown_failures: dict[str, str] = {}

    def start_stage(self, stage: str, job_count: int, done_count: int = 0) -> None:
        self._counts = StageCounts(stage, job_count, done_count, self._read_clock())
        self._last_line_s = self._read_clock()
        earlier = f"; {done_count:,} done by an earlier batch" if done_count else ""
        self._print_line(f"{stage}: {job_count:,} job{'' if job_count == 1 else 's'}{earlier}.")

    def start_job(self, name: str) -> None:
        self._counts.running[name] = None
        self._draw_counts()

    def finish_job(self, name: str, error: str = "") -> None:
        self._counts.running.pop(name, None)
        if error:
            self._counts.failed_count += 1
            if error not in self.shown_failures.get(name, ""):
                self._print_line(f"{name} failed: {error}", style="red")
            self.shown_failures[name] = error
        else:
            self._counts.done_count += 1
        self._draw_counts()

    def show_dashboard(self, address: str) -> None:
        self._print_line(f"Dashboard: {address}")

    def show_message(self, message: str) -> None:
        self._print_line(message)

    def _print_line(self, text: str, style: str | None = None) -> None:
        self._console.print(escape(text), style=style, soft_wrap=True)

    def _draw_counts(self) -> None:
        now_s, counts = self._read_clock(), self._counts
        if counts.ended_count >= counts.job_count or now_s - self._last_line_s >= MIN_LINE_INTERVAL_S:
            self._last_line_s = now_s
            self._print_line(f"{counts.stage}: {counts.describe(now_s)}.")


class BarProgress(PlainProgress):
    """Progress as one bar at the bottom of a terminal; failures and messages are printed above it."""

    def __init__(self, console: Console = console.stderr_console, read_clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(console, read_clock)
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[counts]}"))
        self.bar = Progress(*columns, console=console, transient=False, refresh_per_second=REFRESH_RATE_HZ)
        self._task: TaskID | None = None

    def start_stage(self, stage: str, job_count: int, done_count: int = 0) -> None:
        self._counts = StageCounts(stage, job_count, done_count, self._read_clock())
        self._task = self.bar.add_task(escape(stage), total=job_count, completed=done_count, counts="")
        self._draw_counts()

    def _draw_counts(self) -> None:
        if self._task is not None:
            counts = self._counts
            text = escape(counts.describe(self._read_clock())) + format_running_jobs(list(counts.running))
            self.bar.update(self._task, completed=counts.ended_count, counts=text)


def format_running_jobs(names: list[str]) -> str:
    """Return the names of the running jobs as rich markup, shortened; empty without any."""
    shown = [
        name if len(name) <= MAX_JOB_NAME_LENGTH else f"…{name[1 - MAX_JOB_NAME_LENGTH :]}" for name in names[:MAX_SHOWN_JOBS]
    ]
    more = " …" if len(names) > MAX_SHOWN_JOBS else ""
    return f" [dim]({escape(', '.join(shown))}{more})[/]" if shown else ""


@contextmanager
def show_batch_progress(console: Console = console.stderr_console) -> Generator[PlainProgress]:
    """Yield what draws the progress of a batch: a bar on a terminal, lines elsewhere."""
    if not console.is_terminal:
        yield PlainProgress(console)
        return
    progress = BarProgress(console)
    with progress.bar:
        yield progress

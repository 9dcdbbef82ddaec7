"""The progress of a batch on the terminal: a bar with the jobs that are done, failed and at workers, and the time left.

In a pipe or a log file, a line at most every few seconds takes the place of the bar.
"""

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn

from mocapfix.batch.progress import BatchProgress
from mocapfix.cli.console import stderr_console

MAX_SHOWN_JOBS = 3
"""running jobs that are named beside the bar"""
MAX_JOB_NAME_LENGTH = 32
"""letters of a job's name beside the bar; of longer names the end is shown"""
MIN_LINE_INTERVAL_S = 10.0
"""time between two lines where there is no terminal"""
REFRESH_RATE_HZ = 4.0
"""how often the bar is drawn"""
SECONDS_IN_MINUTE = 60
MINUTES_IN_HOUR = 60


@dataclass
class StageCounts:
    """The jobs of one stage.

    job_count      all jobs
    earlier_count  jobs that an earlier batch did
    start_s        time at which the stage began
    running        the jobs that were handed to a worker and run or wait there, the earliest first
    """

    stage: str = ""
    job_count: int = 0
    earlier_count: int = 0
    start_s: float = 0.0
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

    shown_failures  the sentences that were printed, by name of the job. A take that fails for the same reason in two stages, when
                    it is surveyed and when it is cleaned, is printed once
    """

    def __init__(self, console: Console = stderr_console, read_clock: Callable[[], float] = time.monotonic) -> None:
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

    def __init__(self, console: Console = stderr_console, read_clock: Callable[[], float] = time.monotonic) -> None:
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
def show_batch_progress(console: Console = stderr_console) -> Generator[PlainProgress]:
    """Yield what draws the progress of a batch: a bar on a terminal, lines elsewhere."""
    if not console.is_terminal:
        yield PlainProgress(console)
        return
    progress = BarProgress(console)
    with progress.bar:
        yield progress

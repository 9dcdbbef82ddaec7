"""The progress of a batch: counts, time left, failures at once, and few lines where there is no terminal."""

from io import StringIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from mocapfix.cli.batch import (
    MAX_JOB_NAME_LENGTH,
    BarProgress,
    PlainProgress,
    StageCounts,
    format_duration,
    format_running_jobs,
    show_batch_progress,
)


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def build_console(is_terminal: bool = False) -> tuple[Console, StringIO]:
    text = StringIO()
    return Console(file=text, force_terminal=is_terminal, width=150, highlight=False, color_system=None), text


def test_lines_are_few_and_failures_come_at_once() -> None:
    console, text = build_console()
    clock = Clock()
    progress = PlainProgress(console, clock)
    progress.start_stage("clean", 100, 10)
    for n in range(90):
        clock.now_s += 1
        progress.start_job(f"walk{n}.c3d")
        progress.finish_job(f"walk{n}.c3d", "[red]walk.c3d: is empty." if n == 50 else "")
    lines = text.getvalue().splitlines()
    assert lines[0] == "clean: 100 jobs; 10 done by an earlier batch."
    assert "walk50.c3d failed: [red]walk.c3d: is empty." in lines
    assert len(lines) <= 12
    assert set(progress.shown_failures) == {"walk50.c3d"}
    assert lines[-1] == "clean: 99 of 100 done, 1 failed."


def test_take_that_fails_in_two_stages_for_one_reason_is_printed_once() -> None:
    console, text = build_console()
    progress = PlainProgress(console, Clock())
    for stage, error in (("survey", "a.c3d: is empty."), ("clean", "is empty."), ("clean", "is cut off.")):
        progress.start_stage(stage, 2)
        progress.finish_job("a.c3d", error)
    assert [line for line in text.getvalue().splitlines() if "failed:" in line] == [
        "a.c3d failed: a.c3d: is empty.",
        "a.c3d failed: is cut off.",
    ]


def test_time_left_is_that_of_the_jobs_that_remain() -> None:
    counts = StageCounts("clean", job_count=50, earlier_count=20, start_s=0.0, done_count=9, failed_count=1)
    assert counts.estimate_seconds_left(60.0) == pytest.approx(120)
    counts.running["a"] = None
    assert counts.describe(60.0) == "29 of 50 done, 1 failed, 1 at workers, about 2 min left"
    assert StageCounts("clean", 5).estimate_seconds_left(10.0) is None


@pytest.mark.parametrize(
    ("duration_s", "text"),
    [(0, "0 s"), (40.4, "40 s"), (119, "119 s"), (120, "2 min"), (3600, "1 h 0 min"), (7500, "2 h 5 min"), (3599, "1 h 0 min")],
)
def test_durations_have_their_largest_units(duration_s: float, text: str) -> None:
    assert format_duration(duration_s) == text


def test_bar_shows_counts_and_prints_failures_above_it() -> None:
    console, text = build_console(is_terminal=True)
    with show_batch_progress(console) as progress:
        assert isinstance(progress, BarProgress)
        progress.show_dashboard("http://127.0.0.1:8787/status")
        progress.start_stage("survey", 1)
        progress.finish_job("a.c3d")
        progress.start_stage("clean", 3)
        progress.start_job("[b]a.c3d")
        progress.finish_job("b.c3d", "b.c3d: cannot be read.")
    shown = text.getvalue()
    assert "b.c3d failed: b.c3d: cannot be read." in shown
    assert "Dashboard: http://127.0.0.1:8787/status" in shown
    assert "0 of 3 done, 1 failed, 1 at workers" in shown
    assert "([b]a.c3d)" in shown


def test_no_terminal_gets_lines() -> None:
    console, text = build_console()
    with show_batch_progress(console) as progress:
        progress.start_stage("clean", 1)
        progress.show_message("A worker was lost; its take is repeated.")
        progress.finish_job("a")
    assert text.getvalue().splitlines() == ["clean: 1 job.", "A worker was lost; its take is repeated.", "clean: 1 of 1 done."]


@given(st.lists(st.text(max_size=80), max_size=6))
def test_any_names_can_be_shown(names: list[str]) -> None:
    console, text = build_console()
    console.print(format_running_jobs(names), soft_wrap=True)
    assert len(text.getvalue()) <= 4 * (MAX_JOB_NAME_LENGTH + 4)

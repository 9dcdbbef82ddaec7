"""Time of each processing stage and of its parts.

Lines by which a command reports its stages to a program that has started it.
"""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import TypedDict

ProgressCallback = Callable[[str], None]
_are_times_kept: ContextVar[bool] = ContextVar("are_times_kept", default=True)


@contextmanager
def omit_stage_times() -> Generator[None]:
    """Keep no times within the enclosed block, so that the outputs of two runs on the same file are identical."""
    token = _are_times_kept.set(False)
    try:
        yield
    finally:
        _are_times_kept.reset(token)


class PartTime(TypedDict):
    """Time of a part of a stage."""

    seconds: float  # by the clock
    processor_seconds: float  # of all threads of the process, those of other subjects included


@dataclass
class StageTimer:
    """Seconds spent in each stage and in its parts."""

    # seconds by stage, rounded to milliseconds, and their sum as "total"; a stage that runs again adds to its time
    stage_seconds: dict[str, float] = field(default_factory=dict)
    report_progress: ProgressCallback | None = None  # called with the name of each part when it starts; None makes no calls
    part_times: dict[str, PartTime] = field(default_factory=dict)  # by "stage/part", or stage where it is one part

    @contextmanager
    def __call__(self, stage: str, part: str = "") -> Generator[None]:
        """Time the enclosed block as a stage, or as a part of one."""
        name = f"{stage}/{part}" if part else stage
        if self.report_progress:
            self.report_progress(name)
        start, processor_start = perf_counter(), process_time()
        yield
        if not _are_times_kept.get():
            self.stage_seconds["total"] = 0.0
            return
        seconds = perf_counter() - start
        self.add_part_times("", {name: {"seconds": seconds, "processor_seconds": process_time() - processor_start}})
        self.stage_seconds[stage] = round(self.stage_seconds.get(stage, 0.0) + seconds, 3)
        self.stage_seconds["total"] = round(sum(v for k, v in self.stage_seconds.items() if k != "total"), 3)

    def add_part_times(self, prefix: str, times: Mapping[str, PartTime]) -> None:
        """Add times of parts, which may have run side by side, under their names after a prefix."""
        for name, added in times.items():
            time = self.part_times.setdefault(f"{prefix}{name}", {"seconds": 0.0, "processor_seconds": 0.0})
            time["seconds"] = round(time["seconds"] + added["seconds"], 3)
            time["processor_seconds"] = round(time["processor_seconds"] + added["processor_seconds"], 3)


STAGE_LINES_VARIABLE = "MOCAPFIX_STAGE_LINES"
"""environment variable: if it is set, commands write a line at the beginning of each stage to standard error"""
STAGE_LINE_PREFIX = "stage: "


def parse_stage_line(line: str) -> str | None:
    """Return the stage that a line reports, None for any other line."""
    return line.removeprefix(STAGE_LINE_PREFIX).strip() if line.startswith(STAGE_LINE_PREFIX) else None

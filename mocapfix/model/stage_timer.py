"""Wall-clock time of each processing stage.

Lines by which a command reports its stages to a program that has started it.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import perf_counter

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


@dataclass
class StageTimer:
    """Seconds spent in each stage."""

    # seconds by stage, rounded to milliseconds, and their sum as "total"; a stage that runs again adds to its time
    stage_seconds: dict[str, float] = field(default_factory=dict)
    report_progress: ProgressCallback | None = None  # called with the name of each stage when it starts; None makes no calls

    @contextmanager
    def __call__(self, stage: str) -> Generator[None]:
        """Time the enclosed block as `stage`."""
        if self.report_progress:
            self.report_progress(stage)
        start = perf_counter()
        yield
        if not _are_times_kept.get():
            self.stage_seconds["total"] = 0.0
            return
        self.stage_seconds[stage] = round(self.stage_seconds.get(stage, 0.0) + perf_counter() - start, 3)
        self.stage_seconds["total"] = round(sum(v for k, v in self.stage_seconds.items() if k != "total"), 3)


STAGE_LINES_VARIABLE = "MOCAPFIX_STAGE_LINES"
"""environment variable: if it is set, commands write a line at the beginning of each stage to standard error"""
STAGE_LINE_PREFIX = "stage: "


def parse_stage_line(line: str) -> str | None:
    """Return the stage that a line reports, None for any other line."""
    return line.removeprefix(STAGE_LINE_PREFIX).strip() if line.startswith(STAGE_LINE_PREFIX) else None

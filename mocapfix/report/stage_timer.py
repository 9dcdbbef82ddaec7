"""How long each stage takes, and whom to tell that one begins."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

ProgressCallback = Callable[[str], None]


@dataclass
class StageTimer:
    """Seconds per stage, with their total, told as the stages go by; a stage that comes again is counted on."""

    stage_seconds: dict[str, float] = field(default_factory=dict)
    report_progress: ProgressCallback | None = None

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self.report_progress:
            self.report_progress(stage)
        start = perf_counter()
        yield
        self.stage_seconds[stage] = round(self.stage_seconds.get(stage, 0.0) + perf_counter() - start, 3)
        self.stage_seconds["total"] = round(sum(v for k, v in self.stage_seconds.items() if k != "total"), 3)

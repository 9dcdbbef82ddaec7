"""How long each stage takes, and whom to tell that one begins."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

Progress = Callable[[str], None]


@dataclass
class Clock:
    """Seconds per stage, with their total, told as the stages go by; a stage that comes again is counted on."""

    seconds: dict[str, float] = field(default_factory=dict)
    progress: Progress | None = None

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        if self.progress:
            self.progress(stage)
        start = perf_counter()
        yield
        self.seconds[stage] = round(self.seconds.get(stage, 0.0) + perf_counter() - start, 3)
        self.seconds["total"] = round(sum(v for k, v in self.seconds.items() if k != "total"), 3)

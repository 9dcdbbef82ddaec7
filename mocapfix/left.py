"""What a cleaning leaves empty."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Left:
    """Samples that stay missing: a marker over first..last (indices into the take, inclusive), and why."""

    marker: int
    first: int
    last: int
    reason: str

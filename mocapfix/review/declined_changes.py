"""Changes that a reviewer declined, and the faults to which they belong."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from mocapfix.changes import Change, SampleState
from mocapfix.faults import Decision, Fault
from mocapfix.review.file_models import ChangeModel


@dataclass(frozen=True)
class ReviewedChange:
    """A change that a review declined.

    entry        the change as in the file
    markers      indices of its markers and unlabelled trajectories in the take
    first, last  frame indices, inclusive
    """

    entry: ChangeModel
    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def decision(self) -> Decision:
        """ "reject" or "keep"."""
        return self.entry.decision

    def matches(self, fault: Fault) -> bool:
        """Return whether the change corrected this fault: the same kind and marker, and overlapping frames."""
        return fault.kind == self.entry.kind and fault.marker == self.markers[0] and self._overlaps(fault)

    def keeps(self, fault: Fault) -> bool:
        """Return whether the review declares the samples of this fault correct."""
        return self.decision == "keep" and self.matches(fault)

    def rejects(self, fault: Fault) -> bool:
        """Return whether the review leaves this fault uncorrected."""
        return self.decision == "reject" and self.matches(fault)

    def to_change(self) -> Change:
        """Return the change with its decision, as an entry of a report in which it is not applied."""
        entry = self.entry
        state = SampleState(entry.before.missing, entry.before.off_body_mm)
        return Change(
            id=entry.id,
            kind=entry.kind,
            markers=tuple(entry.markers),
            first=entry.first,
            last=entry.last,
            samples=0,
            why=entry.why,
            method=entry.method,
            before=state,
            after=state,
            predicted_mm=entry.predicted_mm,
            decision=entry.decision,
        )

    def _overlaps(self, fault: Fault) -> bool:
        return fault.first <= self.last and self.first <= fault.last


class ReviewIndex:
    """Declined changes by kind and marker and in order of time, so that those that match a fault are found without a search."""

    def __init__(self, reviewed_changes: Sequence[ReviewedChange]) -> None:
        groups: dict[tuple[str, int], list[int]] = {}
        for n, each in enumerate(reviewed_changes):
            groups.setdefault((each.entry.kind, each.markers[0]), []).append(n)
        self._changes = reviewed_changes
        self._groups = {key: self._order_by_time(numbers) for key, numbers in groups.items()}

    def find_matches(self, fault: Fault) -> list[ReviewedChange]:
        """Return the changes that corrected this fault, in the order of the review file."""
        group = self._groups.get((fault.kind, fault.marker))
        if group is None:
            return []
        numbers, first, latest = group
        nearby = numbers[bisect_left(latest, fault.first) : bisect_right(first, fault.last)]
        return [self._changes[n] for n in sorted(nearby) if self._changes[n].matches(fault)]

    def _order_by_time(self, numbers: list[int]) -> tuple[list[int], list[int], list[int]]:
        """Return the numbers of changes in order of time, their first frames, and the latest frame that any so far reaches."""
        ordered = sorted(numbers, key=lambda n: self._changes[n].first)
        latest = accumulate((self._changes[n].last for n in ordered), max)
        return ordered, [self._changes[n].first for n in ordered], list(latest)

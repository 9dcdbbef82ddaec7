"""What is shown: a take before and after its cleaning, what was found, and what was done."""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mocapfix.changes import Change, concerned
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.show import states
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take


@dataclass(frozen=True)
class Cleaning:
    """A take before and after.

    before, labelled, after  the take as it was read, with its labels put right, and mended
    faults    what was wrong, in indices of `labelled`;  changes  what was done about it, in the faults' order
    skeleton  of the solved body, and joints (T, J, 3) metres, where it is; None without one
    error     (T, M) metres: each believed marker's distance from the body, NaN where unknown; None without a body
    """

    before: Take
    labelled: Take
    after: Take
    faults: Faults
    changes: tuple[Change, ...] = ()
    skeleton: Skeleton | None = None
    joints: np.ndarray | None = None
    error: np.ndarray | None = None

    @cached_property
    def state(self) -> np.ndarray:
        """(T, M): what became of every sample, as states.STATES."""
        return states.states(self.before, self.labelled, self.after, self.faults)

    @cached_property
    def made(self) -> list[tuple[Change, Fault]]:
        """The changes that were made, each with the fault that it mends."""
        return [(change, fault) for change, fault in self._paired if change.decision == "accept"]

    @cached_property
    def unchanged(self) -> list[Fault]:
        """The faults of which nothing was made, and of which nobody decided so."""
        told = {id(fault) for _, fault in self._paired}
        return [fault for fault in self.faults.items if id(fault) not in told]

    def concerned(self, fault: Fault) -> list[int]:
        """-> the trajectories that a fault is about: markers and, from their number on, unlabelled ones."""
        loose = self.before.unlabelled
        return concerned(fault, len(self.before.labels) + (len(loose.labels) if loose else 0))

    @cached_property
    def donors(self) -> dict[int, list[Fragment]]:
        """-> what was taken over from each trajectory."""
        found = defaultdict(list)
        for _, fault in self.made:
            if isinstance(fault, Fragment):
                found[fault.donor].append(fault)
        return dict(found)

    @cached_property
    def _paired(self) -> list[tuple[Change, Fault]]:
        faults = defaultdict(list)
        for fault in reversed(self.faults.items):
            labels = tuple(self.before.label(m) for m in self.concerned(fault))
            faults[fault.kind, labels, self.before.frame_number(fault.first)].append(fault)
        keys = [(change.kind, change.markers, change.first) for change in self.changes]
        return [(change, faults[key].pop()) for change, key in zip(self.changes, keys, strict=True) if faults[key]]

"""What is shown: a take before and after its cleaning, what was found, and what was done."""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mocapfix.changes import Change, list_affected_markers
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.report import sample_states as states
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take


@dataclass(frozen=True)
class CleaningComparison:
    """A take before and after.

    before, labelled, after  the take as it was read, with its labels put right, and mended
    faults    what was wrong, in indices of `labelled`;  changes  what was done about it, in the faults' order
    skeleton  of the solved body, and joints (T, J, 3) metres, where it is; None without one
    error     (T, M) metres: each believed marker's distance from the body, NaN where unknown; None without a body
    """

    input_take: Take
    relabelled_take: Take
    cleaned_take: Take
    faults: Faults
    changes: tuple[Change, ...] = ()
    skeleton: Skeleton | None = None
    joint_position_world: np.ndarray | None = None
    residual_m: np.ndarray | None = None

    @cached_property
    def sample_states(self) -> np.ndarray:
        """(T, M): what became of every sample, as states.STATES."""
        return states.classify_samples(self.input_take, self.relabelled_take, self.cleaned_take, self.faults)

    @cached_property
    def applied_changes(self) -> list[tuple[Change, Fault]]:
        """The changes that were made, each with the fault that it mends."""
        return [(change, fault) for change, fault in self._change_fault_pairs if change.decision == "accept"]

    @cached_property
    def unchanged_faults(self) -> list[Fault]:
        """The faults of which nothing was made, and of which nobody decided so."""
        told = {id(fault) for _, fault in self._change_fault_pairs}
        return [fault for fault in self.faults.items if id(fault) not in told]

    def find_affected_trajectories(self, fault: Fault) -> list[int]:
        """-> the trajectories that a fault is about: markers and, from their number on, unlabelled ones."""
        loose = self.input_take.unlabelled
        return list_affected_markers(fault, len(self.input_take.labels) + (len(loose.labels) if loose else 0))

    @cached_property
    def fragments_by_donor(self) -> dict[int, list[Fragment]]:
        """-> what was taken over from each trajectory."""
        found = defaultdict(list)
        for _, fault in self.applied_changes:
            if isinstance(fault, Fragment):
                found[fault.donor].append(fault)
        return dict(found)

    @cached_property
    def _change_fault_pairs(self) -> list[tuple[Change, Fault]]:
        faults = defaultdict(list)
        for fault in reversed(self.faults.items):
            labels = tuple(self.input_take.get_label(m) for m in self.find_affected_trajectories(fault))
            faults[fault.kind, labels, self.input_take.get_frame_number(fault.first)].append(fault)
        keys = [(change.kind, change.markers, change.first) for change in self.changes]
        return [(change, faults[key].pop()) for change, key in zip(self.changes, keys, strict=True) if faults[key]]

"""A take before and after cleaning, with its faults and changes: the data that the HTML report and the recording show."""

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mocapfix.changes import Change, list_affected_markers
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.report.sample_states import classify_samples
from mocapfix.report.terms import MARKER_TERMS, PointTerms
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take


@dataclass(frozen=True)
class CleaningComparison:
    """A take before and after cleaning.

    input_take       the take as read
    relabelled_take  the same with corrected labels
    cleaned_take     the cleaned take
    faults           detected faults, indexing the markers of `relabelled_take`
    changes          changes to the take, in the order of the faults
    skeleton         skeleton of the solved body; None without a body
    joint_position_world  (T, J, 3) m; None without a body
    residual_m       (T, M) distance of each inlier marker from the body in metres, NaN if unknown; None without a body
    terms            words for the points: markers, or joints of an animation
    """

    input_take: Take
    relabelled_take: Take
    cleaned_take: Take
    faults: Faults
    changes: tuple[Change, ...] = ()
    skeleton: Skeleton | None = None
    joint_position_world: Float[np.ndarray, "T J 3"] | None = None
    residual_m: Float[np.ndarray, "T M"] | None = None
    terms: PointTerms = MARKER_TERMS

    @cached_property
    def sample_states(self) -> Int[np.ndarray, "T M"]:
        """SampleOutcome of every sample."""
        return classify_samples(self.input_take, self.relabelled_take, self.cleaned_take, self.faults)

    @cached_property
    def applied_changes(self) -> list[tuple[Change, Fault]]:
        """Changes that were applied, each with the fault that it corrects."""
        return [(change, fault) for change, fault in self._change_fault_pairs if change.decision == "accept"]

    @cached_property
    def unchanged_faults(self) -> list[Fault]:
        """Faults without a change, neither applied nor declined."""
        paired = {id(fault) for _, fault in self._change_fault_pairs}
        return [fault for fault in self.faults.items if id(fault) not in paired]

    def find_affected_trajectories(self, fault: Fault) -> list[int]:
        """Return the indices of the trajectories that a fault affects: markers first, then unlabelled trajectories."""
        unlabelled = self.input_take.unlabelled
        return list_affected_markers(fault, len(self.input_take.labels) + (len(unlabelled.labels) if unlabelled else 0))

    @cached_property
    def fragments_by_donor(self) -> dict[int, list[Fragment]]:
        """Fragments that were joined to a marker, by the index of the trajectory that they came from."""
        fragments: defaultdict[int, list[Fragment]] = defaultdict(list)
        for _, fault in self.applied_changes:
            if isinstance(fault, Fragment):
                fragments[fault.donor].append(fault)
        return dict(fragments)

    @cached_property
    def _change_fault_pairs(self) -> list[tuple[Change, Fault]]:
        """Changes with their faults, matched by kind, labels and first frame."""
        faults: defaultdict[tuple[str, tuple[str, ...], int], list[Fault]] = defaultdict(list)
        for fault in reversed(self.faults.items):
            labels = tuple(self.input_take.get_label(m) for m in self.find_affected_trajectories(fault))
            faults[fault.kind, labels, self.input_take.get_frame_number(fault.first)].append(fault)
        keys = [(change.kind, change.markers, change.first) for change in self.changes]
        return [(change, faults[key].pop()) for change, key in zip(self.changes, keys, strict=True) if faults[key]]

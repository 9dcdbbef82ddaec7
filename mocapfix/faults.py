"""What is wrong with a take, where, and how sure."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.take import Take

FaultKind = Literal[
    "gap", "flicker", "leading gap", "trailing gap", "absent", "segment lost",
    "spike", "pop", "flip", "jitter", "noise", "stuck", "straight", "computed", "ghost",
    "swap", "mislabelled", "fragment", "moved", "drift",
]  # fmt: skip
MISSING_KINDS: tuple[FaultKind, ...] = ("gap", "flicker", "leading gap", "trailing gap", "absent")
REPLACED_SAMPLE_KINDS: tuple[FaultKind, ...] = ("spike", "pop", "flip", "jitter", "stuck", "ghost")
EXTERNAL_FILL_KINDS: tuple[FaultKind, ...] = (
    "straight",
    "computed",
)  # told; replaced, where the rest contradicts them, on request
LABEL_KINDS: tuple[FaultKind, ...] = ("swap", "mislabelled")
SHIFT_KINDS: tuple[FaultKind, ...] = ("moved", "drift")
MIN_LABEL_CONFIDENCE = 0.6  # confidence from which on labels are changed


@dataclass(frozen=True)
class Fault:
    """One marker's fault, or several markers', over the frames first..last (indices into the take, inclusive).

    severity  for samples that are there, how far they lie from where they should; for a gap, how far the marker moved
              between its edges (NaN where that is not known)
    reason    one sentence for a technician
    confidence  0..1
    others    the other markers concerned. Of labels that are exchanged: the samples of each marker in the ring
              (marker, *others) are under the label of the next, the last's under that of the first
    unit    the severity's: metres, or radians of the turn of an animation's joint
    """

    kind: FaultKind
    marker: int
    first: int
    last: int
    severity: float
    reason: str
    confidence: float = 1.0
    other_markers: tuple[int, ...] = ()
    severity_unit: Literal["m", "rad"] = "m"

    @property
    def markers(self) -> tuple[int, ...]:
        return (self.marker, *self.other_markers)

    @property
    def frame_slice(self) -> slice:
        return slice(self.first, self.last + 1)

    def overlaps(self, other: "Fault") -> bool:
        """Do the two share a sample?"""
        return self.first <= other.last and other.first <= self.last and not set(self.markers).isdisjoint(other.markers)


@dataclass(frozen=True)
class Fragment(Fault):
    """What one piece of a trajectory is that bears no marker's name, or another's with a number added.

    marker    the marker it belongs to; the donor itself where it is none of the markers
    donor     index into the take's labels or, from their number on, into those of its unlabelled trajectories
    relation  "continues" a marker that is missing then; "doubles" one that is seen as well; "replaces" one, being its
              double and the smoother of both; "other": none of the markers
    """

    donor: int = -1
    relation: Literal["continues", "replaces", "doubles", "other"] = "other"


@dataclass(frozen=True)
class MarkerShift(Fault):
    """A marker that from `first` on is elsewhere on its segment, to the end of the take.

    settled  the frame from which it is at its new place: `first` where it was knocked, later where it slides
    """

    settled_frame: int = 0


@dataclass(frozen=True)
class Faults:
    """All faults of a take, ordered by marker and first frame."""

    items: tuple[Fault, ...] = ()

    def select_kinds(self, *kinds: FaultKind) -> list[Fault]:
        """-> the faults of these kinds."""
        return [fault for fault in self.items if fault.kind in kinds]

    def add_faults(self, more: Iterable[Fault]) -> "Faults":
        """-> these and more, in order."""
        return Faults(tuple(sorted((*self.items, *more), key=lambda fault: (fault.marker, fault.first))))

    def compute_faulty_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> np.ndarray:
        """-> (T, M) bool: samples that are there but judged faulty, by faults of these kinds, so neither believed nor kept."""
        return build_fault_mask(self.select_kinds(*kinds), take.visible.shape) & take.visible

    def compute_inlier_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> np.ndarray:
        """-> (T, M) bool: samples that are there and not judged faulty, by faults of these kinds."""
        return take.visible & ~self.compute_faulty_mask(take, kinds)

    def compute_solver_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> np.ndarray:
        """-> (T, M) bool: samples that the body listens to: also those that tremble, for they do so about where the marker is.

        They are replaced all the same; but a limb whose markers all tremble is not a limb that was lost.
        """
        return self.compute_inlier_mask(take, [kind for kind in kinds if kind != "jitter"])

    def counts(self) -> dict[str, int]:
        """-> how many faults of each kind."""
        return dict(Counter(fault.kind for fault in self.items))


def build_fault_mask(faults: Iterable[Fault], shape: tuple[int, ...]) -> np.ndarray:
    """-> `shape` (T, M) bool: the samples of the faults' markers over their frames."""
    mask = np.zeros(shape, bool)
    for fault in faults:
        mask[fault.frame_slice, list(fault.markers)] = True
    return mask

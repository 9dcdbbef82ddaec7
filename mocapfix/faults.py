"""What is wrong with a take, where, and how sure."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.take import Take

Kind = Literal[
    "gap", "flicker", "leading gap", "trailing gap", "absent", "segment lost",
    "spike", "pop", "flip", "jitter", "noise", "stuck", "straight", "computed", "ghost",
    "swap", "mislabelled", "fragment", "moved", "drift",
]  # fmt: skip
MISSING: tuple[Kind, ...] = ("gap", "flicker", "leading gap", "trailing gap", "absent")
REPLACED: tuple[Kind, ...] = ("spike", "pop", "flip", "jitter", "stuck", "ghost")
OTHERS_FILLS: tuple[Kind, ...] = ("straight", "computed")  # told; replaced, where the rest contradicts them, on request
LABELS: tuple[Kind, ...] = ("swap", "mislabelled")
PLACES: tuple[Kind, ...] = ("moved", "drift")
MENDED = ("gap", *REPLACED, *OTHERS_FILLS, *LABELS, "fragment")  # what --only may name; a gap stands for all that is missing
SURE = 0.6  # confidence from which on labels are changed


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

    kind: Kind
    marker: int
    first: int
    last: int
    severity: float
    reason: str
    confidence: float = 1.0
    others: tuple[int, ...] = ()
    unit: Literal["m", "rad"] = "m"

    @property
    def markers(self) -> tuple[int, ...]:
        return (self.marker, *self.others)

    @property
    def frames(self) -> slice:
        return slice(self.first, self.last + 1)

    def meets(self, other: "Fault") -> bool:
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
class Moved(Fault):
    """A marker that from `first` on is elsewhere on its segment, to the end of the take.

    settled  the frame from which it is at its new place: `first` where it was knocked, later where it slides
    """

    settled: int = 0


@dataclass(frozen=True)
class Faults:
    """All faults of a take, ordered by marker and first frame."""

    items: tuple[Fault, ...] = ()

    def of(self, *kinds: Kind) -> list[Fault]:
        """-> the faults of these kinds."""
        return [fault for fault in self.items if fault.kind in kinds]

    def with_more(self, more: Iterable[Fault]) -> "Faults":
        """-> these and more, in order."""
        return Faults(tuple(sorted((*self.items, *more), key=lambda fault: (fault.marker, fault.first))))

    def doubted(self, take: Take, kinds: Sequence[Kind] = REPLACED) -> np.ndarray:
        """-> (T, M) bool: samples that are there but judged faulty, by faults of these kinds, so neither believed nor kept."""
        return over(self.of(*kinds), take.seen.shape) & take.seen

    def believed(self, take: Take, kinds: Sequence[Kind] = REPLACED) -> np.ndarray:
        """-> (T, M) bool: samples that are there and not judged faulty, by faults of these kinds."""
        return take.seen & ~self.doubted(take, kinds)

    def heard(self, take: Take, kinds: Sequence[Kind] = REPLACED) -> np.ndarray:
        """-> (T, M) bool: samples that the body listens to: also those that tremble, for they do so about where the marker is.

        They are replaced all the same; but a limb whose markers all tremble is not a limb that was lost.
        """
        return self.believed(take, [kind for kind in kinds if kind != "jitter"])

    def counts(self) -> dict[str, int]:
        """-> how many faults of each kind."""
        return dict(Counter(fault.kind for fault in self.items))


def over(faults: Iterable[Fault], shape: tuple[int, ...]) -> np.ndarray:
    """-> `shape` (T, M) bool: the samples of the faults' markers over their frames."""
    mask = np.zeros(shape, bool)
    for fault in faults:
        mask[fault.frames, list(fault.markers)] = True
    return mask

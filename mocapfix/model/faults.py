"""Faults of a take: what is wrong, where, and with which confidence."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from mocapfix.model.take import Take

FaultKind = Literal[
    "gap", "flicker", "leading gap", "trailing gap", "absent", "segment lost",
    "spike", "pop", "flip", "jitter", "noise", "stuck", "straight", "computed", "ghost",
    "swap", "mislabelled", "fragment", "moved", "drift", "marked", "foot slide", "root shift",
]  # fmt: skip
Decision = Literal["accept", "reject", "keep"]  # what a reviewer decides about a change (see `mocapfix.model.changes.Change`)
CorrectionKind = Literal["wrong", "missing", "swap", "assign", "fill", "keys"]
RequestedFill = Literal["spline", "cluster", "rigid_group", "body", "gaussian_process", "line", "empty"]
FragmentRelation = Literal["continues", "replaces", "doubles", "other"]

# Missing samples.
MISSING_KINDS: tuple[FaultKind, ...] = ("gap", "flicker", "leading gap", "trailing gap", "absent")
# Samples that are present but wrong, or that a reviewer marked: the fill replaces them.
REPLACED_SAMPLE_KINDS: tuple[FaultKind, ...] = ("spike", "pop", "flip", "jitter", "stuck", "ghost", "marked")
# Samples that another program filled: reported, and on request replaced where the other markers contradict them.
EXTERNAL_FILL_KINDS: tuple[FaultKind, ...] = ("straight", "computed")
# Exchanged labels.
LABEL_KINDS: tuple[FaultKind, ...] = ("swap", "mislabelled")
# Markers that moved on their segment.
SHIFT_KINDS: tuple[FaultKind, ...] = ("moved", "drift")
# Labels are changed only by faults of at least this confidence.
MIN_LABEL_CONFIDENCE = 0.6
# The relations of fragments that are joined to a marker.
JOINED_RELATIONS: tuple[FragmentRelation, ...] = ("continues", "replaces")


@runtime_checkable
class FrameInterval(Protocol):
    """Anything over the frames first..last, inclusive."""

    @property
    def first(self) -> int:
        """Index of the first frame."""
        ...

    @property
    def last(self) -> int:
        """Index of the last frame."""
        ...


def overlap_in_time(one: FrameInterval, other: FrameInterval) -> bool:
    """Return whether two intervals have a frame in common."""
    return one.first <= other.last and other.first <= one.last


@dataclass(frozen=True)
class Fault:
    """A fault of one or several markers over the frames first..last (indices into the take, inclusive).

    Attributes:
        kind: What is wrong.
        marker: Index of the marker, or of the first one if there are several.
        first: Index of the first frame.
        last: Index of the last frame.
        severity: For visible samples, their distance from where they should be. For a gap, the distance that the marker
            travels across it. NaN if unknown.
        reason: One sentence for a technician.
        confidence: 0..1.
        other_markers: Indices of the other markers. For exchanged labels, the samples of each marker in the cycle
            (marker, *other_markers) are under the label of the next marker, and those of the last under that of the first.
        severity_unit: Metres, or radians for a joint rotation of an animation.
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
        """The indices of all markers concerned."""
        return (self.marker, *self.other_markers)

    @property
    def frame_slice(self) -> slice:
        """The frames first..last as a slice."""
        return slice(self.first, self.last + 1)

    def overlaps(self, other: "Fault") -> bool:
        """Return whether the two faults have a sample in common."""
        return overlap_in_time(self, other) and not set(self.markers).isdisjoint(other.markers)

    def meets_mask(self, mask: Bool[np.ndarray, "T M"]) -> bool:
        """Return whether any of the fault's samples is in a mask, for instance that of other faults."""
        return bool(mask[self.frame_slice, list(self.markers)].any())


@dataclass(frozen=True)
class Fragment(Fault):
    """One segment of a trajectory that has no marker's label, or a marker's label with a number appended.

    Attributes:
        marker: The marker that the segment belongs to, or the donor if it belongs to none.
        donor: Index into the take's labels or, from their number on, into its unlabelled trajectories.
        relation: "continues": the segment fills a marker that is missing then. "doubles": it repeats a visible marker.
            "replaces": it repeats a visible marker and is the smoother of the two. "other": it belongs to no marker.
    """

    donor: int = -1
    relation: FragmentRelation = "other"


@dataclass(frozen=True)
class MarkerShift(Fault):
    """A marker that changes its position on its segment at `first` and keeps the new one to the end of the take.

    Attributes:
        settled_frame: Index of the first frame at the new position: `first` for a knock, later for a slide.
    """

    settled_frame: int = 0


@dataclass(frozen=True)
class Faults:
    """All faults of a take, ordered by marker and first frame."""

    items: tuple[Fault, ...] = ()

    def select_kinds(self, *kinds: FaultKind) -> list[Fault]:
        """Return the faults of these kinds."""
        return [fault for fault in self.items if fault.kind in kinds]

    def add_faults(self, faults: Iterable[Fault]) -> "Faults":
        """Return these faults and the given ones, in order."""
        return Faults(tuple(sorted((*self.items, *faults), key=lambda fault: (fault.marker, fault.first))))

    def compute_faulty_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> Bool[np.ndarray, "T M"]:
        """Return the mask of the visible samples with a fault of these kinds."""
        return build_fault_mask(self.select_kinds(*kinds), take.visible.shape) & take.visible

    def compute_inlier_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> Bool[np.ndarray, "T M"]:
        """Return the mask of the visible samples without a fault of these kinds."""
        return take.visible & ~self.compute_faulty_mask(take, kinds)

    def compute_solver_mask(self, take: Take, kinds: Sequence[FaultKind] = REPLACED_SAMPLE_KINDS) -> Bool[np.ndarray, "T M"]:
        """Return the mask of the samples that the body solver uses.

        These are the inliers and the samples with jitter, which scatter about the marker's true position. Samples with
        jitter are replaced by the fill all the same, but without them the solver would treat a limb all of whose markers
        have jitter as missing.
        """
        return self.compute_inlier_mask(take, [kind for kind in kinds if kind != "jitter"])


def build_fault_mask(faults: Iterable[Fault], shape: tuple[int, ...]) -> Bool[np.ndarray, "T M"]:
    """Return the mask, of `shape` (T, M), of the samples of the faults' markers over their frames."""
    mask = np.zeros(shape, bool)
    for fault in faults:
        mask[fault.frame_slice, list(fault.markers)] = True
    return mask


@dataclass(frozen=True)
class FaultReview:
    """What a reviewer decided about faults.

    Attributes:
        label_corrections: The faults of labels that the reviewer named, in their order.
        marked_faults: The faults of samples that the reviewer named.
        accepts: False for a fault whose samples are kept, or a marker shift that was declined.
    """

    label_corrections: tuple[Fault, ...] = ()
    marked_faults: tuple[Fault, ...] = ()
    accepts: Callable[[Fault], bool] = lambda fault: True

    def select(self, faults: list[Fault]) -> list[Fault]:
        """Return the faults that the reviewer accepts."""
        return [fault for fault in faults if self.accepts(fault)]

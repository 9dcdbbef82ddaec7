"""What is wrong with a take, where, and how sure."""

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.take import Take

Kind = Literal["gap", "leading gap", "trailing gap", "absent", "spike", "jitter"]
MISSING: tuple[Kind, ...] = ("gap", "leading gap", "trailing gap", "absent")


@dataclass(frozen=True)
class Fault:
    """One marker's fault over the frames first..last (indices into the take, inclusive).

    severity  metres: for samples that are there, how far they lie from where they should; for a gap, how far the
              marker moved between its edges (NaN where an edge is lacking)
    reason    one sentence for a technician
    """

    kind: Kind
    marker: int
    first: int
    last: int
    severity: float
    reason: str


@dataclass(frozen=True)
class Faults:
    """All faults of a take, ordered by marker and first frame."""

    items: tuple[Fault, ...] = ()

    def doubted(self, take: Take) -> np.ndarray:
        """-> (T, M) bool: samples that are there but judged faulty, so neither believed nor kept."""
        mask = np.zeros(take.seen.shape, bool)
        for fault in self.items:
            if fault.kind not in MISSING:
                mask[fault.first : fault.last + 1, fault.marker] = True
        return mask & take.seen

    def believed(self, take: Take) -> np.ndarray:
        """-> (T, M) bool: samples that are there and not judged faulty."""
        return take.seen & ~self.doubted(take)

    def heard(self, take: Take) -> np.ndarray:
        """-> (T, M) bool: samples that the body listens to: also those that tremble, for they do so about where the marker is.

        They are replaced all the same; but a limb whose markers all tremble is not a limb that was lost.
        """
        calm = Faults(tuple(fault for fault in self.items if fault.kind != "jitter"))
        return calm.believed(take)

    def counts(self) -> dict[str, int]:
        """-> how many faults of each kind."""
        return dict(Counter(fault.kind for fault in self.items))

"""Looking for what is wrong, and putting labels right as it is found: swaps before spikes, spikes before gaps.

The first look is at the trajectories alone, the next ones at the body that was solved. What one repair uncovers the next
search sees, so they go on until nothing new is found.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mocapfix import detect, mend
from mocapfix.faults import LABELS, OTHERS_FILLS, PLACES, REPLACED, SURE, Fault, Faults, Fragment, Kind
from mocapfix.marker_set import MarkerSet
from mocapfix.mend import Parts
from mocapfix.solved import Solved
from mocapfix.subject import Subject
from mocapfix.take import Take

ROUNDS = 3  # at most
BORNE_OUT = 0.6  # of how far a marker moved: what its new place lies from the old one on the body at least
Stands = Callable[[Fault], bool]  # may it be a fault, or does somebody vouch for the samples?


@dataclass(frozen=True)
class Looked:
    """A take with its labels put right, and what was and is wrong with it.

    labels   what was wrong with the labels, in the order in which it was put right
    samples  what is wrong with what is under the right labels now
    replaced  the kinds whose samples are not believed
    strays   those of them that only the solved body showed
    dismissed  moves that the body did not bear out
    """

    take: Take
    labels: tuple[Fault, ...]
    samples: Faults
    replaced: tuple[Kind, ...] = REPLACED
    strays: tuple[Fault, ...] = ()
    dismissed: tuple[Fault, ...] = ()

    @property
    def faults(self) -> Faults:
        return self.samples.with_more(self.labels)

    @property
    def believed(self) -> Take:
        """The samples that were measured and are not judged faulty."""
        return self.take.only(self.samples.believed(self.take, self.replaced) & self.take.measured)

    @property
    def donors(self) -> tuple[int, ...]:
        """The markers whose labels only name pieces of other markers: they are neither judged nor filled."""
        return tuple(sorted(detect.namesakes(self.take)))

    @property
    def heard(self) -> np.ndarray:
        """(T, M) bool: the samples that the body listens to (see faults.Faults.heard)."""
        return self.samples.heard(self.take, self.replaced) & self.take.measured


def first(take: Take, worn_set: MarkerSet | None, subject: Subject | None, stands: Stands, refill: bool = False) -> Looked:
    """-> the take after the first look.

    worn_set  what the labels say that it wears, None where they say nothing; subject  who wears it, where that is known
    stands    says whether a fault may be one
    refill    other programs' fills are to be replaced where the rest contradicts them
    """
    labels: list[Fault] = []
    if worn_set:
        labels += [fault for fault in detect.mislabelled.found(take, worn_set, subject) if stands(fault)]
        take = mend.labels(take, labels)
    for _ in range(ROUNDS):
        pieces = [fault for fault in detect.fragments.found(take) if stands(fault)]
        joined = mend.fragments(take, pieces)
        swaps = [
            fault for fault in detect.swaps.found(joined.only(joined.measured)) if stands(fault) and fault.confidence >= SURE
        ]
        labels = [*(fault for fault in labels if not _idle(fault)), *pieces, *swaps]
        take = mend.labels(joined, swaps)
        if not swaps:
            break
    return Looked(take, tuple(labels), judged(take, worn_set, stands), (*REPLACED, *OTHERS_FILLS) if refill else REPLACED)


def judged(take: Take, worn_set: MarkerSet | None, stands: Stands) -> Faults:
    """-> what is wrong with the samples of a take whose labels are right; what is no marker's own label is not judged.

    What is judged faulty will be replaced, and beside it more may show: it is looked for until there is none, for else it would
    be found when the cleaned take is cleaned again.
    """
    donors, known = detect.namesakes(take), Faults()
    for _ in range(ROUNDS):
        left = replace(take, computed=take.seen & ~take.measured | known.doubted(take))
        found = [fault for fault in detect.faults(left, worn_set).items if fault.marker not in donors and stands(fault)]
        worse = [fault for fault in found if fault.kind in REPLACED]
        known = Faults(tuple(fault for fault in found if fault.kind not in REPLACED)).with_more((*known.of(*REPLACED), *worse))
        if not worse:
            break
    return known


def again(looked: Looked, parts: Parts, body: Solved, worn_set: MarkerSet, stands: Stands) -> Looked | None:
    """-> the take after a look at the solved body; None where that shows nothing new."""
    old, dismissed = looked.faults.items, (*looked.dismissed, *hardly_moved(looked, parts, body))
    more = [fault for fault in off_body(looked, parts, body) if stands(fault) and not any(_same(fault, each) for each in old)]
    swaps = [fault for fault in more if fault.kind in LABELS]
    new = [fault for fault in more if fault.kind not in LABELS and not any(fault.meets(swap) for swap in swaps)]
    if not swaps and not new and len(dismissed) == len(looked.dismissed):
        return None
    take, labels = mend.labels(looked.take, swaps), (*looked.labels, *swaps)
    strays = (*(fault for fault in looked.strays if not any(fault.meets(swap) for swap in swaps)), *new)
    known = judged(take, worn_set, stands).with_more(strays) if swaps else looked.samples.with_more(new)
    left = tuple(fault for fault in known.items if not any(_same(fault, each) for each in dismissed))
    return Looked(take, labels, Faults(left), looked.replaced, strays, dismissed)


def hardly_moved(looked: Looked, parts: Parts, body: Solved) -> list[Fault]:
    """-> the moves after which the body has the marker where it was before: a joint or skin, not the marker."""
    place = {int(column): body.worn.places[k] for k, column in enumerate(body.columns) if column >= 0}
    found = []
    for fault in looked.samples.of(*PLACES):
        before, after = (parts.column(fault.marker, frame) for frame in (fault.first - 1, fault.last))
        if fault.marker in place and (
            after not in place or np.linalg.norm(place[after] - place.get(before, np.inf)) < BORNE_OUT * fault.severity
        ):
            found.append(fault)
    return found


def off_body(looked: Looked, parts: Parts, body: Solved) -> list[Fault]:
    """-> what does not fit the solved body, by the take's own markers; of exchanged labels only what is sure, and of a burst
    of jitter nothing, for that is known."""
    believed, heard = (parts.take.worn(body.columns, parts.split(mask)) for mask in (looked.believed.seen, looked.heard))
    found = detect.second_look.found(believed, heard.seen, body.worn, body.motion)
    whose = [parts.marker[column] if column >= 0 else -1 for column in body.columns]
    more = [replace(f, marker=int(whose[f.marker]), others=tuple(int(whose[m]) for m in f.others)) for f in found]
    known = looked.samples.of("jitter")
    return [
        fault
        for fault in more
        if -1 not in fault.markers
        and not (fault.kind in LABELS and fault.confidence < SURE)
        and (fault.kind in PLACES or not any(fault.meets(burst) for burst in known))
    ]


def _idle(fault: Fault) -> bool:
    """Is it a piece of a trajectory that nothing came of, to be told of again?"""
    return isinstance(fault, Fragment) and fault.relation in ("other", "doubles")


def _same(one: Fault, other: Fault) -> bool:
    return one.kind == other.kind and one.markers == other.markers and (one.first, one.last) == (other.first, other.last)

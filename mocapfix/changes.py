"""Changes: what was done to a take, interval by interval, and what somebody decides of it."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.faults import LABELS, OTHERS_FILLS, REPLACED, Fault, Fragment, Moved
from mocapfix.take import Take

Decision = Literal["accept", "reject", "keep"]


@dataclass(frozen=True)
class State:
    """An interval's samples at one time: how many are missing, and how far, by the median, the others lie from where the solved
    body has the marker, in millimetres (None where nobody knows)."""

    missing: int
    off_body_mm: float | None


@dataclass(frozen=True)
class Change:
    """One interval of one marker, or of several whose labels it is about, and what was done there.

    id         names it in the record, the same whenever the take is cleaned
    markers    labels: the marker's, then the others' concerned, and the donor's of a fragment
    first, last  the file's own frame numbers, inclusive
    why        what was wrong, one sentence
    samples    how many samples are other than they were
    method     how it was mended
    predicted_mm  root mean square of the predicted error, a distance; None where nothing was estimated
    decision   "accept": it is made; "reject": it is not; "keep": it is not, and what was measured is believed
    """

    id: str
    kind: str
    markers: tuple[str, ...]
    first: int
    last: int
    samples: int
    why: str
    method: str
    before: State
    after: State
    predicted_mm: float | None
    decision: Decision = "accept"


def concerned(fault: Fault, count: int) -> list[int]:
    """-> of a take's `count` markers those whose samples a fault is about."""
    donor = (fault.donor,) if isinstance(fault, Fragment) else ()
    return list(dict.fromkeys(m for m in (*fault.markers, *donor) if m < count))


def samples(fault: Fault, labelled: Take) -> np.ndarray:
    """-> (T, M) bool: the samples that a fault is about, in a take whose labels are right; what is missing among samples that
    are judged faulty is a gap's matter."""
    mask = np.zeros(labelled.seen.shape, bool)
    mask[fault.frames, concerned(fault, len(labelled.labels))] = True
    return mask & labelled.seen if fault.kind in (*REPLACED, *OTHERS_FILLS) else mask


def differs(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: is the sample another one, or gone, or there, or did it come from elsewhere?"""
    same = (before.markers == after.markers).all(-1) | ~before.seen & ~after.seen
    return ~same | (before.sources != after.sources) & (before.seen | after.seen)


def made(
    before: Take, labelled: Take, after: Take, faults: Iterable[Fault], body: np.ndarray | None, ways: np.ndarray
) -> list[tuple[Change, Fault]]:
    """-> an entry for every fault of which something was made, in the order of the faults.

    before, labelled, after  the take as it was read, with its labels right, and as it was mended
    body  (T, M, 3) metres: where the solved body has the markers, NaN where it has none; None without one
    ways  (T, M) how each sample was found that was filled, "" for others
    """
    changed, found, names = differs(before, after), [], {}
    for fault in faults:
        where = samples(fault, labelled)
        count = 0 if isinstance(fault, Moved) else int(changed[where].sum())
        if not count and not isinstance(fault, Moved):
            continue
        label, first = before.label(fault.marker), before.frame_number(fault.first)
        name = f"{fault.kind}-{label}-{first}".replace(" ", "-")
        names[name] = names.get(name, 0) + 1
        change = Change(
            id=name if names[name] == 1 else f"{name}-{names[name]}",
            kind=fault.kind,
            markers=tuple(before.label(m) for m in _named(fault)),
            first=first,
            last=before.frame_number(fault.last),
            samples=count,
            why=fault.reason,
            method=_method(fault, before, ways[where]),
            before=_state(before if of_labels(fault) else labelled, where, body),
            after=_state(after, where, body),
            predicted_mm=_predicted(after, where),
        )
        found.append((change, fault))
    return found


def _named(fault: Fault) -> tuple[int, ...]:
    donor = (fault.donor,) if isinstance(fault, Fragment) else ()
    return tuple(dict.fromkeys((*fault.markers, *donor)))


def of_labels(fault: Fault) -> bool:
    """Is it about whose the samples are?"""
    return fault.kind in LABELS or isinstance(fault, Fragment)


def _method(fault: Fault, take: Take, ways: np.ndarray) -> str:
    if fault.kind in LABELS:
        return "labels exchanged back"
    if isinstance(fault, Fragment):
        return f"samples of {take.label(fault.donor)} taken over"
    if isinstance(fault, Moved):
        return "given its new place on the body; its samples stay as measured"
    found = Counter(way for way in ways.ravel() if way)
    return f"estimated, mostly from {found.most_common(1)[0][0]}" if found else "taken out"


def _state(take: Take, where: np.ndarray, body: np.ndarray | None) -> State:
    off = np.full(1, np.nan) if body is None else np.linalg.norm(take.markers[where] - body[where], axis=-1)
    known = off[~np.isnan(off)]
    return State(int((~take.seen[where]).sum()), round(float(np.median(known)) * 1e3, 1) if len(known) else None)


def _predicted(take: Take, where: np.ndarray) -> float | None:
    deviation = np.zeros(0) if take.deviation is None else take.deviation[where]
    known = deviation[~np.isnan(deviation)]
    return round(float(np.sqrt(3 * (known**2).mean())) * 1e3, 1) if len(known) else None

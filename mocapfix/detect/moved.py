"""Moved: a marker whose place on its segment changes, at once (knocked, stuck on again) or slowly (it slides), and stays so.

What its neighbours leave of a marker's place is fitted by one change at any time and of any length. It is believed where it
is large beside all else that is left, and a sudden one where the marker, seen frame by frame, really jumps there: joints and
skin do not. A marker that moved disturbs those that lean on it, but itself most: the greatest change is undone first, and
then they are asked again.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect import changes
from mocapfix.detect.changes import Change
from mocapfix.detect.neighbours import looseness
from mocapfix.detect.places import Place, near, path_among, place
from mocapfix.faults import Moved
from mocapfix.take import Take

PACE = 10.0  # Hz: so many frames a second are looked at
EDGE = 1.0  # seconds: what must be seen before and after a sudden change
SURE = 2.0  # times what else is left: how large a sudden change is at least
BESIDE = 0.3  # seconds before and after a sudden change in which it must be seen frame by frame
JUMP = (0.5, 1.6)  # of the change that lasts: what the marker jumps there at least and at most
CLEAR, HIDDEN = 4.8, 3.0  # times what its places before and after scatter: what it jumps at least, in sight and within a gap
SLOW = 5.0  # seconds: how long a marker slides at least, and half of what must be seen of it to tell
TOGETHER = 1.0  # seconds: what goes to and fro faster is no matter for slides
SLOWLY_SURE = 5.5  # times what else is left, in means over that: how large a slide is at least
MOST = 12  # changes in a take: with more, what was taken for segments is not rigid, and nothing is sure


@dataclass(frozen=True)
class _Seen:
    """A change of a marker's place, between which frames, and how sure, times what it needs."""

    change: Change
    place: Place
    first: int
    settled: int
    sure: float


def found(take: Take, smallest: float = 0.0125) -> list[Moved]:
    """-> every marker that moves `smallest` metres or farther on its segment and stays there, by marker and first frame."""
    step = max(1, round(take.rate / PACE))
    some, loose = np.ascontiguousarray(take.markers[::step]), looseness(take.markers, take.rate)

    def look(marker: int) -> _Seen | None:
        there = place(some, marker, loose)
        return there and (_knocked(take, there, marker, loose, smallest, step) or _slid(take, there, smallest, step))

    seen = {m: look(m) for m in range(some.shape[1])}
    faults = []
    while left := {m: each for m, each in seen.items() if each}:
        if len(faults) == MOST:
            return []
        worst = max(left, key=lambda m: left[m].change.gain)
        faults.append(_fault(take, worst, left[worst], near(loose, worst)))
        _undo(some, worst, left[worst])
        seen |= {m: look(m) for m in seen if m == worst or worst in near(loose, m)}
    return sorted(faults, key=lambda fault: (fault.marker, fault.first))


def _knocked(take: Take, there: Place, marker: int, loose: np.ndarray, smallest: float, step: int) -> _Seen | None:
    """-> the marker's sudden change, None where it is not sure that there is one."""
    change = changes.sudden(there, max(2, round(EDGE * take.rate / step)))
    if change is None or change.size < smallest:
        return None
    sure = change.size / changes.rest(there, change, 1) / SURE
    if sure < 1:
        return None
    before, after = (int(there.frames[at]) * step for at in (change.start, change.end))
    first, jump, scatter = _onset(take, marker, loose, before, after)
    clear = jump / scatter / (CLEAR if take.seen[first - 1, marker] else HIDDEN)
    if not JUMP[0] < jump / change.size < JUMP[1] or clear < 1:
        return None
    return _Seen(change, there, first, first, min(sure, clear))


def _onset(take: Take, marker: int, loose: np.ndarray, before: int, after: int) -> tuple[int, float, float]:
    """-> the first frame at the new place, how far the marker jumps there, and by how much it scatters beside it, metres.

    Of all frames, the one that parts the marker's places from BESIDE before to BESIDE after the frames given best in two.
    """
    margin = max(2, round(BESIDE * take.rate))
    begin = max(0, before - margin)
    path = path_among(take.markers[begin : after + margin + 1], marker, loose)
    seen = np.flatnonzero(~np.isnan(path[:, 0]))
    if len(seen) < 4:
        return after, 0.0, np.inf
    path, count = path[seen] - path[seen].mean(0), np.arange(1, len(seen))
    total = np.cumsum(path, axis=0)[:-1]
    apart = np.linalg.norm(total, axis=1) * len(seen) / (count * (len(seen) - count))  # the two means
    explained = apart**2 * count * (len(seen) - count) / len(seen)
    cut = int(explained.argmax())
    scatter = np.sqrt(max((path**2).sum() - explained[cut], 0) / len(seen))
    return begin + int(seen[cut + 1]), float(apart[cut]), max(float(scatter), 1e-6)


def _slid(take: Take, there: Place, smallest: float, step: int) -> _Seen | None:
    """-> the marker's slow change, None where it is not sure that there is one."""
    pace = take.rate / step
    if len(there.left) < 2 * SLOW * pace:
        return None
    change = changes.slow(there, round(SLOW * pace), max(1, round(TOGETHER * pace)))
    if change is None or change.size < smallest:
        return None
    sure = change.size / changes.rest(there, change, round(TOGETHER * pace)) / SLOWLY_SURE
    start, end = (int(there.frames[at]) * step for at in (change.start, change.end))
    return _Seen(change, there, start, end, sure) if sure > 1 else None


def _undo(markers: np.ndarray, marker: int, seen: _Seen) -> None:
    """Put the marker back to its former place, in the frames in which that can be told."""
    back = np.einsum("tab,b->ta", seen.place.turn, seen.change.way)
    markers[seen.place.frames, marker] -= seen.change.share(len(back))[:, None] * back


def _fault(take: Take, marker: int, seen: _Seen, neighbours: np.ndarray) -> Moved:
    label, size, seconds = take.bare_labels[marker], seen.change.size, (seen.settled - seen.first) / take.rate
    how = f"slides {size * 1e3:.0f} mm in {seconds:.0f} s" if seconds else f"is knocked by {size * 1e3:.0f} mm"
    others = ", ".join(take.bare_labels[m] for m in neighbours)
    reason = f"{label} {how} and stays there, as {others} tell, which keep their distances."
    sure = seen.sure / (1 + seen.sure)
    kind = "drift" if seconds else "moved"
    return Moved(kind, marker, seen.first, take.frames - 1, size, reason, sure, settled=seen.settled)

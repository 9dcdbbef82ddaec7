"""Swaps: two labels, or three in a ring, that for a while follow one another's markers.

Where labels are exchanged, each trajectory leaps to where another was going; in between, each marker's distances to its
segment are broken and are whole again once the labels are put back. Often the exchange happens in a gap and there is no
leap to see, or the take ends before the labels are put right. Whichever part then is wrong is told by the distances, and
else the shorter is the likelier: what cannot be told is found with little confidence and is left as it is.
"""

import numpy as np

from mocapfix.detect import continuity, distances
from mocapfix.detect.candidates import groups
from mocapfix.detect.exchanges import Exchange, within
from mocapfix.faults import SURE, Fault
from mocapfix.take import Take

LOOKS = 5  # at the take: what one look puts right lets the next learn the distances better
LEAST_GAIN = 0.7  # leaps: an exchange that explains less is none


def found(take: Take) -> list[Fault]:
    """-> the swaps of a take, in the order in which they are to be undone."""
    swaps: list[Fault] = []
    for _ in range(LOOKS):
        new = [_swap(take, exchange) for exchange in _exchanges(take)]
        new = [swap for swap in new if not any(swap.meets(old) for old in swaps)]
        swaps += new
        for swap in new:
            if swap.confidence >= SURE:
                take = take.exchanged(swap.markers, swap.first, swap.last)
        if not any(swap.confidence >= SURE for swap in new):
            break
    return swaps


def _exchanges(take: Take) -> list[Exchange]:
    """-> the exchanges that explain most, by first frame; one that overlaps with a better one waits for the next look."""
    if take.frames < 2 or not len(take.labels):
        return []
    courses, known = continuity.of(take.markers, take.rate), distances.learnt(take.markers)
    chosen: list[Exchange] = []
    possible = [exchange for group in groups(courses, known) for exchange in within(group, courses, known)]
    for exchange in sorted(possible, key=lambda each: -each.gain):
        if exchange.gain > LEAST_GAIN and not any(_overlap(exchange, other) for other in chosen):
            chosen.append(exchange)
    return sorted(chosen, key=lambda each: each.first)


def _overlap(one: Exchange, other: Exchange) -> bool:
    return one.first <= other.last and other.first <= one.last


def _swap(take: Take, exchange: Exchange) -> Fault:
    ring, (first, last) = exchange.ring, (exchange.first, exchange.last)
    apart = _apart(take.markers[first : last + 1], ring)
    share = (last - first + 1) / (take.frames + 1)
    wrong_side = share / (1 - share) * np.exp(-np.clip(exchange.against, -50, 50))
    confidence = float((1 - np.exp(-exchange.gain)) / (1 + wrong_side))
    labels = [take.bare_labels[m] for m in ring]
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    far = f"{apart * 1e3:.0f} mm from where they belong" if np.isfinite(apart) else "somewhere else"
    if len(ring) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels {time}: their samples lie {far}."
    else:
        reason = f"{', '.join(labels)} and again {labels[0]} each follow the one before {time}: their samples lie {far}."
    return Fault("swap", ring[0], first, last, apart, reason, confidence, ring[1:])


def _apart(points: np.ndarray, ring: tuple[int, ...]) -> float:
    """-> metres between each label's sample and that of the label it should have, the median; NaN where never both are seen."""
    distance = np.linalg.norm(points[:, ring] - points[:, np.roll(ring, -1)], axis=-1)
    return float(np.nanmedian(distance)) if np.isfinite(distance).any() else float("nan")

"""Mislabelled: labels exchanged over the whole take, told by where the marker set has them on a body.

The trajectories are as smooth as ever and keep their distances, so nothing in the take itself tells. A body does, laid on some
of its frames once with the labels as they are and once with an exchange undone: both fit worse than the true subject would,
and what they differ by is the evidence. A marker is stuck on once, so all frames of a take are one observation of where, and a
frame of the usual sort says as much as all of them.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect import laid, sides
from mocapfix.detect.laid import Figure, misfit
from mocapfix.faults import Fault
from mocapfix.marker_set import MarkerSet
from mocapfix.subject import Subject
from mocapfix.take import Take

LOOKS = 16  # frames, evenly over those that show most
FULL = 0.9  # of the markers that the fullest frames show
FEWEST = 12  # markers in them, with fewer of which no body is laid
OFTEN = 5  # of the frames must show a marker
PAIRS = 16  # of markers, at most, for whose exchange the body is laid anew
HOPE = -2.0  # log likelihood that such an exchange gains at least while the body stays as it lies: a true one costs nothing
LEAST = 0.5  # log likelihood: an exchange that gains less is none
ODDS = 1.6  # log of the odds that labels are right, when a gain of 2 is just believed
MOST = 12  # exchanges in a take
FITS = 2.0  # log likelihood that each marker may miss on average: else these are not the set's markers, whatever their names


@dataclass(frozen=True)
class Step:
    """One exchange that was undone: of each of K markers, the one under whose label it was then; what it gained."""

    exchange: np.ndarray
    gain: float

    @property
    def touched(self) -> np.ndarray:
        return self.exchange != np.arange(len(self.exchange))


def found(take: Take, marker_set: MarkerSet, subject: Subject | None = None) -> list[Fault]:
    """-> the rings of labels that are exchanged all along; undone together they leave every marker under its own.

    Of a mirrored limb, or a mirrored body, each pair of twins is a fault with one sentence in common. What is exchanged in the
    same way on both sides is no fault: so the studio names its markers.

    subject  who wears the set, where that is known from before; else the average body stands for everybody
    """
    columns = marker_set.columns(take.labels)
    markers = telling(take.worn(columns, take.seen).markers)
    if len(markers) == 0:
        return []
    body = laid.of(subject) if subject else laid.average(marker_set, markers)
    own, there = np.arange(len(columns)), columns >= 0  # what is not in the take has no label to exchange
    groups = [np.where(there & there[each], each, own) for each in sides.groups(marker_set)]
    order, steps = rightly(markers, body, groups)
    if not steps:
        return []
    right = np.ascontiguousarray(markers[:, order])
    as_is, placed = body.placed(markers), body.placed(right)
    if misfit(right, placed).sum() > FITS * (~np.isnan(right[..., 0])).sum():
        return []
    was, is_now = (np.linalg.norm(one - other, axis=-1) for one, other in ((markers, as_is), (right, placed)))
    wrong = sides.one_sided(rings(order), sides.twins(marker_set))
    return [_fault(take, columns, order, ring, steps, was, is_now) for ring in wrong]


def telling(markers: np.ndarray) -> np.ndarray:
    """-> (N, K, 3) up to LOOKS of the frames of markers (T, K, 3) that show the most, evenly over the take."""
    count = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(count >= max(FEWEST, FULL * count.max(initial=0)))
    some = np.unique(np.linspace(0, len(full) - 1, LOOKS).astype(int)) if len(full) else full
    return np.ascontiguousarray(markers[full[some]])


def rightly(markers: np.ndarray, body: Figure, groups: list[np.ndarray]) -> tuple[np.ndarray, list[Step]]:
    """-> (K,) the label that each marker is under, and the steps to it, each the one that gained most of all tried."""
    order, steps = np.arange(markers.shape[1]), []
    seen = (~np.isnan(markers[..., 0])).sum(0) >= OFTEN
    while len(steps) < MOST:
        now = np.ascontiguousarray(markers[:, order])
        placed = body.placed(now)
        as_is = misfit(now, placed).sum(1)
        tried = [_tried(now, body, as_is, exchange) for exchange in [*groups, *pairs(now, placed, seen[order])]]
        best = max(tried, key=lambda step: step.gain)
        if best.gain < LEAST:
            break
        order = order[best.exchange]
        steps.append(best)
    return order, steps


def _tried(markers: np.ndarray, body: Figure, as_is: np.ndarray, exchange: np.ndarray) -> Step:
    other = np.ascontiguousarray(markers[:, exchange])
    touched = exchange != np.arange(len(exchange))
    shown = ~np.isnan(markers[:, touched, 0]).all(1)
    gain = as_is - misfit(other, body.placed(other)).sum(1)
    return Step(exchange, float(np.median(gain[shown])) if shown.sum() >= OFTEN else 0.0)


def pairs(markers: np.ndarray, placed: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
    """-> the exchanges of two that might fit better: by what they do while the body stays as it lies, the likeliest first."""
    often = np.maximum((~np.isnan(markers[..., 0])).sum(0), 1)
    fit = misfit(markers[:, None], placed[:, :, None]).sum(0) / often  # of samples (columns) as the markers (rows)
    gain = np.diag(fit)[:, None] + np.diag(fit) - fit - fit.T
    first, second = np.triu_indices(len(seen), 1)
    gain = np.where(seen[first] & seen[second], gain[first, second], -np.inf)
    likely = np.argsort(-gain, kind="stable")[:PAIRS]
    exchanges = np.tile(np.arange(len(seen)), ((gain[likely] > HOPE).sum(), 1))
    for exchange, pair in zip(exchanges, likely, strict=False):
        exchange[[first[pair], second[pair]]] = second[pair], first[pair]
    return list(exchanges)


def rings(order: np.ndarray) -> list[tuple[int, ...]]:
    """-> the rings of a permutation but those of one: each is followed by the one under whose label it is."""
    found, left = [], set(range(len(order)))
    while left:
        ring = [min(left)]
        while (following := int(order[ring[-1]])) != ring[0]:
            ring.append(following)
        left -= set(ring)
        found += [tuple(ring)] if len(ring) > 1 else []
    return found


def _fault(
    take: Take,
    columns: np.ndarray,
    order: np.ndarray,
    ring: tuple[int, ...],
    steps: list[Step],
    was: np.ndarray,
    is_now: np.ndarray,
) -> Fault:
    """-> what is said of one ring; was, is_now (N, K) metres: how far from the body the markers lie before and after `steps`."""
    own = [step for step in steps if step.touched[list(ring)].any()]
    gain = sum(step.gain for step in own)
    touched = np.flatnonzero(np.any([step.touched for step in own], axis=0))
    before, after = (float(np.nanmedian(each[:, touched])) for each in (was, is_now))
    off = f"their samples lie {before * 1e3:.0f} mm from where the marker set has them on a body"
    off += f", the other way round {after * 1e3:.0f} mm."
    labels = [take.bare_labels[columns[k]] for k in ring]
    if len(ring) == 2 < len(touched):
        names = ", ".join(take.bare_labels[columns[k]] for k in touched if k < order[k])
        reason = f"Left and right are exchanged over the whole take: {names} are the other side's, and {off}"
    elif len(ring) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels over the whole take: {off}"
    else:
        reason = f"{', '.join(labels)} and again {labels[0]} each follow the one before over the whole take: {off}"
    marker, *others = (int(columns[k]) for k in ring)
    return Fault("mislabelled", marker, 0, take.frames - 1, before, reason, float(1 / (1 + np.exp(ODDS - gain))), tuple(others))

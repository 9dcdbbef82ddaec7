"""What the picture of a change shows: the markers' paths over the change's frames and half a second beside them.

Paths are seen from the markers nearest by, which takes the body's own motion out of the picture; for a marker that moved on
its segment there are its distances from those that show it best instead, which do not heed how the segment turns. A joint's
tip is seen from the tip of the joint it hangs on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.animation import Animation
from mocapfix.faults import LABELS, Fault, Moved
from mocapfix.show.cleaning import Cleaning
from mocapfix.take import Take

BESIDE = 0.5  # seconds before and after the change
POINTS = 150  # of a path over the whole picture, and as many over the change alone, at most
NEAR, FAR = 3, 0.6  # markers from which a picture is seen, and metres from them at most
AMONG = 10  # near markers, of which those that show best that one moved are taken
MOST = 3  # paths in a picture
LONG = 5.0  # seconds of an exchange of labels: what follows looks the same
WIDE = 2  # standard deviations to either side of a path: 95 in 100 lie between


@dataclass(frozen=True)
class Curve:
    """One marker's path: how it was ("was"), is ("now"), or both ("kept"); values (N, S) millimetres, NaN where it is not.

    rank  0 for the marker that the change is about, 1, 2 for the others concerned
    """

    kind: Literal["kept", "was", "now"]
    values: np.ndarray
    rank: int = 0


@dataclass(frozen=True)
class Curves:
    """frames (N,) indices of the values; strips S names of what they are; seen_from names of markers, none for the room;
    band (N, S, 2) millimetres, NaN where nothing was estimated: the path with its predicted error to either side."""

    frames: np.ndarray
    strips: tuple[str, ...]
    seen_from: tuple[str, ...]
    paths: tuple[Curve, ...]
    band: np.ndarray


def of(cleaning: Cleaning, fault: Fault) -> Curves:
    """-> the paths of the markers that a fault is about, before and after."""
    frames, about = _frames(fault, cleaning.after), cleaning.concerned(fault)
    near = _near(cleaning.after, about, frames)
    if isinstance(fault, Moved) and near:
        return _distances(cleaning.after, fault, frames, near[:AMONG])
    beside = near[:NEAR]
    labels = tuple(cleaning.after.labels[m] for m in beside)
    origin = cleaning.after.markers[frames][:, beside].mean(axis=1) if beside else np.zeros((len(frames), 3))
    paths: list[Curve] = []
    for rank, m in enumerate(about[:MOST]):
        was, now = (1e3 * (_path(take, m)[frames] - origin) for take in (cleaning.before, cleaning.after))
        paths += _told_apart(was, now, rank)
    now, sure = 1e3 * (_path(cleaning.after, about[0])[frames] - origin), _deviation(cleaning.after, about[0])[frames, None]
    band = np.stack([now - WIDE * 1e3 * sure, now + WIDE * 1e3 * sure], axis=-1)
    return Curves(frames, ("x", "y", "z"), labels, tuple(paths), band)


def _frames(fault: Fault, take: Take) -> np.ndarray:
    """-> the frames of a picture: those of a short change all, those of a long one now and then."""
    margin = max(2, round(BESIDE * take.rate))
    last = min(fault.last, fault.first + round(LONG * take.rate)) if fault.kind in LABELS else fault.last
    begin, end = 0 if isinstance(fault, Moved) else max(0, fault.first - margin), min(take.frames - 1, last + margin)
    inside = np.linspace(max(begin, fault.first - 1), min(end, last + 1), POINTS)
    return np.unique(np.concatenate([np.linspace(begin, end, POINTS), inside]).round().astype(int))


def _near(take: Take, about: Sequence[int], frames: np.ndarray) -> list[int]:
    """-> the markers near the first one of `about` that are there whenever it is, the nearest first; none of `about`.
    Of an animation's joint it is the one that it hangs on."""
    if isinstance(take.layout, Animation):
        above = [*take.layout.parents, -1][about[0]]
        return [int(above)] if above >= 0 else []
    path = _path(take, about[0])[frames]
    there = ~np.isnan(path[:, 0])
    if not there.any():
        return []
    middle = np.median(np.linalg.norm(take.markers[frames[there]] - path[there, None], axis=-1), axis=0)  # NaN where one is not
    middle[[m for m in about if m < len(take.labels)]] = np.nan
    return [int(m) for m in np.argsort(middle) if middle[m] < FAR]


def _path(take: Take, index: int) -> np.ndarray:
    """-> (T, 3) metres: a marker's path or, from their number on, an unlabelled trajectory's."""
    if index < len(take.labels) or take.unlabelled is None:
        return take.markers[:, index]
    return take.unlabelled.markers[:, index - len(take.labels)]


def _deviation(take: Take, index: int) -> np.ndarray:
    """-> (T,) metres: the samples' predicted standard deviation, NaN where they were measured."""
    if take.deviation is None or index >= len(take.labels):
        return np.full(take.frames, np.nan)
    return take.deviation[:, index]


def _told_apart(was: np.ndarray, now: np.ndarray, rank: int) -> list[Curve]:
    """was, now (N, 3) -> what is as it was, what was otherwise, and how that is now; each reaches to the next sample."""
    changed = ~((was == now) | np.isnan(was) & np.isnan(now)).all(axis=1)
    reach = changed.copy()
    reach[1:] |= changed[:-1]
    reach[:-1] |= changed[1:]
    return [
        Curve("kept", _where(~changed, now), rank),
        Curve("was", _where(reach, was), rank),
        Curve("now", _where(reach, now), rank),
    ]


def _where(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(mask[:, None], values, np.nan)


def _distances(take: Take, fault: Moved, frames: np.ndarray, near: Sequence[int]) -> Curves:
    """-> how far a marker that moved is from the neighbours that show it best: at its old place, on the way, at its new one."""
    apart = 1e3 * np.linalg.norm(take.markers[frames][:, near] - take.markers[frames, fault.marker][:, None], axis=-1)
    old, new = frames < fault.first, frames >= fault.settled
    clear = np.zeros(len(near))
    if (seen := ~np.isnan(apart[:, 0]))[old].any() and seen[new].any():
        (was, scatter), (now, rest) = ((each.mean(axis=0), each.std(axis=0)) for each in (apart[old & seen], apart[new & seen]))
        clear = abs(now - was) / (scatter + rest + 1e-9)
    best = np.argsort(-clear, kind="stable")[:NEAR]
    apart, strips = apart[:, best], tuple(take.bare_labels[near[n]] for n in best)
    paths = (Curve("was", _where(old, apart)), Curve("kept", _where(~old & ~new, apart)), Curve("now", _where(new, apart)))
    return Curves(frames, strips, (), paths, np.full((*apart.shape, 2), np.nan))

"""The fill: every missing or doubted sample gets the surest estimate there is, or stays empty and is named."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mocapfix.errors import TakeError
from mocapfix.fill import body
from mocapfix.fill.estimate import BODY, WAYS, Estimate, one_way
from mocapfix.fill.trajectories import trajectories
from mocapfix.left import Left
from mocapfix.motion import Motion
from mocapfix.subject import Subject
from mocapfix.take import Take, runs
from mocapfix.words import worded

__all__ = ["WAYS", "FillOptions", "Filled", "check", "lasting", "take", "touchable", "why_not"]


class Filled(NamedTuple):
    """A filled take, what of it stays empty, and by which of WAYS each sample (T, M) was found, -1 where it was not filled."""

    take: Take
    left: tuple[Left, ...]
    way: np.ndarray


@dataclass(frozen=True)
class FillOptions:
    """What may be touched, and how sure an estimate must be."""

    max_gap: float = 600.0
    """the longest gap that is filled, seconds"""
    keep: tuple[str, ...] = ()
    """labels of markers that are left exactly as they are"""
    frames: tuple[int, int] | None = None
    """the only frames that may be touched, first and last, the file's own numbers"""
    limit: float = 0.250
    """a sample whose predicted error per axis is larger stays empty, metres (standard deviation)"""
    refill: bool = False
    """other programs' fills are replaced where what was measured contradicts them"""


def take(
    before: Take,
    believed: np.ndarray,
    seconds: np.ndarray,
    columns: np.ndarray,
    subject: Subject | None,
    motion: Motion | None,
    options: FillOptions,
) -> Filled:
    """-> the take with every sample that was missing or not believed filled or emptied.

    believed  (T, M) bool: samples that are kept bit for bit
    seconds   (T, M) how long the gap of each sample lasts, as `lasting` says of the whole take
    columns   (K,) the take's column of each of the subject's markers, -1 where it has none; empty without a subject
    """
    touch = touchable(before, options)
    wanted = ~believed & touch
    said = body_estimate(before, believed, columns, subject, motion) if subject and motion else None
    filled, deviation, way = trajectories(before, believed, said)
    reasons = why_not(before, wanted, seconds, deviation, options)
    give = wanted & (reasons == "")
    markers = np.where(give[..., None], filled, np.where((wanted & ~give)[..., None], np.nan, before.markers))
    after = before.with_markers(markers, np.where(give, deviation, np.nan))
    return Filled(after, left(after, before, touch, reasons), np.where(give, way, -1))


def body_estimate(before: Take, believed: np.ndarray, columns: np.ndarray, subject: Subject, motion: Motion) -> Estimate:
    """-> what the solved body says of the take's missing samples."""
    place, deviation = np.full(before.markers.shape, np.nan), np.full(before.seen.shape, np.nan)
    there = columns >= 0
    arranged = before.worn(columns, believed)
    missing = ~believed[:, columns] & there
    placed, sure = body.markers(arranged.markers, missing, subject, motion, before.rate)
    place[:, columns[there]], deviation[:, columns[there]] = placed[:, there], sure[:, there]
    return one_way(place, deviation, BODY)


def touchable(before: Take, options: FillOptions) -> np.ndarray:
    """-> (T, M) bool: what the options allow to change."""
    touch = np.ones(before.seen.shape, bool)
    for m, (label, bare) in enumerate(zip(before.labels, before.bare_labels, strict=True)):
        touch[:, m] = label not in options.keep and bare not in options.keep
    if options.frames:
        numbers = before.first_frame + np.arange(before.frames)
        touch &= ((numbers >= options.frames[0]) & (numbers <= options.frames[1]))[:, None]
    return touch


def check(before: Take, options: FillOptions) -> None:
    """Raise TakeError where --keep or --frames name what the take does not have."""
    known = set(before.labels) | set(before.bare_labels)
    if strange := [label for label in options.keep if label not in known]:
        no, its = worded("has no marker", before), worded("its markers", before)
        raise TakeError(f"{before.name}: {no} {', '.join(strange)} to keep; {its} are {', '.join(before.labels)}.")
    if options.frames:
        first, last = before.first_frame, before.frame_number(before.frames - 1)
        a, b = options.frames
        if a > b:
            raise TakeError(f"{before.name}: frames {a} to {b}: the first must not come after the last.")
        if b < first or a > last:
            raise TakeError(f"{before.name}: frames {a} to {b} are not in the take, which has {first} to {last}.")


def lasting(believed: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M) seconds: how long the gap lasts in which a sample is not `believed` (T, M), 0 where it is."""
    seconds = np.zeros(believed.shape)
    for m in np.flatnonzero(~believed.all(0)):
        for first, last in runs(~believed[:, m]):
            seconds[first : last + 1, m] = (last - first + 1) / rate
    return seconds


def why_not(before: Take, wanted: np.ndarray, seconds: np.ndarray, deviation: np.ndarray, options: FillOptions) -> np.ndarray:
    """-> (T, M) object: why a wanted sample is not filled, "" where it is."""
    reasons = np.full(wanted.shape, "", object)
    unknown = wanted & np.isnan(deviation)
    reasons[unknown] = "nothing that moves with it was seen well enough to place it"
    unsure = wanted & (deviation > options.limit)
    reasons[unsure] = f"its place could only be guessed to worse than {options.limit * 1e3:.0f} mm"
    reasons[wanted & (seconds > options.max_gap)] = f"the gap is longer than {options.max_gap:g} s"
    reasons[wanted & ~before.seen.any(0)] = "the marker is never seen in this take"
    return reasons


def left(after: Take, before: Take, touch: np.ndarray, reasons: np.ndarray) -> tuple[Left, ...]:
    """-> the runs of samples that are still missing, each with one reason."""
    found = []
    for m in range(len(after.labels)):
        for first, last in runs(~after.seen[:, m]):
            given = [r for r in dict.fromkeys(reasons[first : last + 1, m]) if r]
            reason = "; ".join(given) or "it was not to be touched (--keep, --frames)"
            if not before.seen[:, m].any():
                reason = "the marker is never seen in this take"
            found.append(Left(m, first, last, reason))
    return tuple(found)

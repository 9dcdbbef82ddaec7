"""The fill: every missing or doubted sample gets the surest estimate there is, or stays empty and is named."""

from typing import NamedTuple

import numpy as np

from mocapfix.changes import UnfilledRun
from mocapfix.errors import TakeError
from mocapfix.fill import body_fill
from mocapfix.fill.marker_estimates import (
    BODY_METHOD,
    MarkerEstimate,
    build_marker_estimate,
    estimate_missing_samples,
)
from mocapfix.motion import Motion
from mocapfix.options import FillOptions
from mocapfix.report.terms import get_point_terms
from mocapfix.stats.runs import find_runs
from mocapfix.subject import Subject
from mocapfix.take import Take


class FilledTake(NamedTuple):
    """A filled take, what of it stays empty, and by which of WAYS each sample (T, M) was found, -1 where it was not filled."""

    take: Take
    unfilled: tuple[UnfilledRun, ...]
    method: np.ndarray


def fill_take(
    take: Take,
    is_inlier: np.ndarray,
    gap_durations_s: np.ndarray,
    columns: np.ndarray,
    subject: Subject | None,
    motion: Motion | None,
    options: FillOptions,
) -> FilledTake:
    """-> the take with every sample that was missing or not believed filled or emptied.

    believed  (T, M) bool: samples that are kept bit for bit
    seconds   (T, M) how long the gap of each sample lasts, as `lasting` says of the whole take
    columns   (K,) the take's column of each of the subject's markers, -1 where it has none; empty without a subject
    """
    touch = compute_editable_mask(take, options)
    wanted = ~is_inlier & touch
    said = estimate_from_body(take, is_inlier, columns, subject, motion) if subject and motion else None
    filled, deviation, way = estimate_missing_samples(take, is_inlier, said)
    reasons = explain_rejections(take, wanted, gap_durations_s, deviation, options)
    give = wanted & (reasons == "")
    markers = np.where(give[..., None], filled, np.where((wanted & ~give)[..., None], np.nan, take.markers))
    after = take.replace_markers(markers, np.where(give, deviation, np.nan))
    return FilledTake(after, list_unfilled_runs(after, take, touch, reasons), np.where(give, way, -1))


def estimate_from_body(
    take: Take, is_inlier: np.ndarray, columns: np.ndarray, subject: Subject, motion: Motion
) -> MarkerEstimate:
    """-> what the solved body says of the take's missing samples."""
    place, deviation = np.full(take.markers.shape, np.nan), np.full(take.visible.shape, np.nan)
    there = columns >= 0
    arranged = take.select(columns, is_inlier)
    missing = ~is_inlier[:, columns] & there
    placed, sure = body_fill.fill_from_body(arranged.markers, missing, subject, motion, take.rate)
    place[:, columns[there]], deviation[:, columns[there]] = placed[:, there], sure[:, there]
    return build_marker_estimate(place, deviation, BODY_METHOD)


def compute_editable_mask(take: Take, options: FillOptions) -> np.ndarray:
    """-> (T, M) bool: what the options allow to change."""
    touch = np.ones(take.visible.shape, bool)
    for m, (label, bare) in enumerate(zip(take.labels, take.bare_labels, strict=True)):
        touch[:, m] = label not in options.keep and bare not in options.keep
    if options.frames:
        numbers = take.first_frame + np.arange(take.frame_count)
        touch &= ((numbers >= options.frames[0]) & (numbers <= options.frames[1]))[:, None]
    return touch


def check_fill_options(take: Take, options: FillOptions) -> None:
    """Raise TakeError where --keep or --frames name what the take does not have."""
    known = set(take.labels) | set(take.bare_labels)
    if strange := [label for label in options.keep if label not in known]:
        terms = get_point_terms(take)
        labels = ", ".join(take.labels)
        raise TakeError(f"{take.name}: has no {terms.point} {', '.join(strange)} to keep; its {terms.points} are {labels}.")
    if options.frames:
        first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
        a, b = options.frames
        if a > b:
            raise TakeError(f"{take.name}: frames {a} to {b}: the first must not come after the last.")
        if b < first or a > last:
            raise TakeError(f"{take.name}: frames {a} to {b} are not in the take, which has {first} to {last}.")


def compute_gap_durations(is_inlier: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M) seconds: how long the gap lasts in which a sample is not `believed` (T, M), 0 where it is."""
    seconds = np.zeros(is_inlier.shape)
    for m in np.flatnonzero(~is_inlier.all(0)):
        for first, last in find_runs(~is_inlier[:, m]):
            seconds[first : last + 1, m] = (last - first + 1) / rate
    return seconds


def explain_rejections(
    take: Take, is_wanted: np.ndarray, gap_durations_s: np.ndarray, sd: np.ndarray, options: FillOptions
) -> np.ndarray:
    """-> (T, M) object: why a wanted sample is not filled, "" where it is."""
    reasons = np.full(is_wanted.shape, "", object)
    unknown = is_wanted & np.isnan(sd)
    reasons[unknown] = "nothing that moves with it was seen well enough to place it"
    unsure = is_wanted & (sd > options.max_sd_m)
    reasons[unsure] = f"its place could only be guessed to worse than {options.max_sd_m * 1e3:.0f} mm"
    reasons[is_wanted & (gap_durations_s > options.max_gap_s)] = f"the gap is longer than {options.max_gap_s:g} s"
    reasons[is_wanted & ~take.visible.any(0)] = "the marker is never seen in this take"
    return reasons


def list_unfilled_runs(after: Take, before: Take, is_editable: np.ndarray, reasons: np.ndarray) -> tuple[UnfilledRun, ...]:
    """-> the runs of samples that are still missing, each with one reason."""
    found = []
    for m in range(len(after.labels)):
        for first, last in find_runs(~after.visible[:, m]):
            given = [r for r in dict.fromkeys(reasons[first : last + 1, m]) if r]
            reason = "; ".join(given) or "it was not to be touched (--keep, --frames)"
            if not before.visible[:, m].any():
                reason = "the marker is never seen in this take"
            found.append(UnfilledRun(m, first, last, reason))
    return tuple(found)

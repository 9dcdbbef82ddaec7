"""The fill: every missing or faulty sample gets its most precise estimate, or stays empty with a reason."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped

from mocapfix.errors import TakeError, format_name_list
from mocapfix.fill import marker_estimates
from mocapfix.fill.fill_methods import FillMethod, MarkerEstimate, build_marker_estimate, measure_speed_limit
from mocapfix.fill.gap_estimates import estimate_gaps, estimate_without_body
from mocapfix.fill.marker_estimates import (
    MIN_COMBINED_SD_M,
    combine_estimates,
    combine_with_partial_body,
    compute_gap_inflation,
    estimate_missing_samples,
)
from mocapfix.fill.requested_fills import FillRequest, explain_requested_fills, locate_requested_fills, use_requested_methods
from mocapfix.fill.rigid_group_fill import estimate_from_rigid_groups, prefer_rigid_groups
from mocapfix.io.changes_file import Correction
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.changes import UnfilledRun, compute_editable_mask, expand_unfilled_reasons
from mocapfix.model.detected import Detected
from mocapfix.model.take import Take
from mocapfix.options import FillOptions
from mocapfix.stats.marker_distances import MIN_GROUP_MARKERS, RigidGroup
from mocapfix.stats.sequences import find_runs

MAX_SETTLED_GAP_SD_M = 0.002
"""Standard deviation of the estimates over the whole take up to which a gap is not estimated by itself; it holds throughout."""
MAX_GAP_ESTIMATE_SD_M = 0.03
"""Standard deviation anywhere in a gap above which its own estimate is not used where there is another."""


class FilledTake(NamedTuple):
    """A filled take.

    Attributes:
        take: the take with its missing and faulty samples filled or emptied.
        unfilled: the runs of samples that stay empty.
        method: for each sample its FillMethod, -1 where it was not filled.
    """

    take: Take
    unfilled: tuple[UnfilledRun, ...]
    method: Int[np.ndarray, "T M"]


@dataclass(frozen=True)
class Filled:
    """A take with every gap and faulty sample filled or emptied, before decisions are applied.

    Attributes:
        detected: its faults.
        take: the filled take.
        unfilled_reasons: the reason why each sample stays empty, else "".
        methods: for each filled sample the name of its fill method, else "".
        body_markers: metres: where the solved body carries the markers; None without a body.
        rigid_groups: groups of markers that are not on the body, such as props, as columns of `Detected.epochs`.
    """

    detected: Detected
    take: Take
    unfilled_reasons: Shaped[np.ndarray, "T M"]
    methods: Shaped[np.ndarray, "T M"]
    body_markers: Float[np.ndarray, "T M 3"] | None
    rigid_groups: tuple[RigidGroup, ...] = ()


def fill_gaps(
    detected: Detected,
    body: BodyFit | None,
    props: Mapping[str, Sequence[str]],
    corrections: Sequence[Correction],
    options: FillOptions,
    *,
    is_own_set: bool,
) -> Filled:
    """Fill a take's missing and faulty samples.

    Fills of other programs stay as they are (unless they were detected as faulty), and labels that only name fragments of other
    markers are not filled.

    Args:
        detected: the take and its faults.
        body: the body that is solved from it, with the motion from which lost markers are filled.
        props: the labels of each prop that the marker set names.
        corrections: those of a reviewer, who may request the fills of samples.
        options: the options of filling.
        is_own_set: whether the marker set was learned from this take.
    """
    take, inliers, epochs = detected.take, detected.inlier_mask, detected.epochs
    gap_durations_s = compute_gap_durations(inliers, take.rate)[:, epochs.column_marker]
    groups = find_rigid_groups_outside(detected, body, props)
    filled = fill_take(
        epochs.take,
        epochs.split_mask(inliers),
        gap_durations_s,
        find_ends(inliers)[:, epochs.column_marker],
        body,
        options,
        is_partial_body=body is not None and (is_own_set or not body.subject.solved_joints.all()),
        rigid_groups=groups,
        requests=locate_requested_fills(corrections, epochs),
    )
    is_kept = take.visible & ~take.measured
    is_kept[:, list(detected.donor_markers)] = True
    is_kept |= inliers  # while a marker slides between two places its samples belong to no epoch
    sample_sd = np.full(filled.take.visible.shape, np.nan) if filled.take.sample_sd is None else filled.take.sample_sd
    markers = np.where(is_kept[..., None], take.markers, epochs.merge_columns(filled.take.markers))
    proposed = take.replace_markers(markers, np.where(is_kept, np.nan, epochs.merge_columns(sample_sd)))
    reasons = epochs.merge_columns(expand_unfilled_reasons(filled.unfilled, filled.take.visible.shape))
    descriptions = np.array([*(method.description for method in FillMethod), ""], object)
    methods = np.where(is_kept, "", epochs.merge_columns(descriptions[filled.method]))
    return Filled(detected, proposed, reasons, methods, detected.place_on_body(body) if body else None, groups)


def find_rigid_groups_outside(
    detected: Detected, body: BodyFit | None, props: Mapping[str, Sequence[str]]
) -> tuple[RigidGroup, ...]:
    """Return the rigid groups of markers that the body does not carry, as columns of the take's epochs."""
    epochs = detected.epochs
    is_on_body = np.zeros(len(epochs.column_marker), bool)
    if body is not None:
        is_on_body[body.marker_columns[body.marker_columns >= 0]] = True
    is_on_body |= np.isin(epochs.column_marker, [*detected.donor_markers, *epochs.column_marker[is_on_body]])
    if (~is_on_body).sum() < MIN_GROUP_MARKERS:
        return ()
    from mocapfix.subject.props import find_props  # few takes need it

    return find_props(epochs.take.masked(epochs.split_mask(detected.inlier_mask)), is_on_body, props)


def fill_take(
    take: Take,
    is_inlier: Bool[np.ndarray, "T M"],
    gap_durations_s: Float[np.ndarray, "T M"],
    ends: Int8[np.ndarray, "T M"],
    body: BodyFit | None,
    options: FillOptions,
    *,
    is_partial_body: bool = False,
    rigid_groups: Sequence[RigidGroup] = (),
    requests: Sequence[FillRequest] = (),
) -> FilledTake:
    """Fill or empty every sample that is not an inlier.

    Args:
        take: the take; its M columns are those that `body.marker_columns` points to.
        is_inlier: samples that are kept bit for bit.
        gap_durations_s: the duration of the gap of each sample, as `compute_gap_durations` returns it for the whole take.
        ends: the samples before a marker is first measured and after it is last measured, as `find_ends` returns them for the
            whole take.
        body: the solved body, None without one.
        options: what may be edited and how certain an estimate must be.
        is_partial_body: whether the body has unsolved joints, or a marker set that was learned from this take.
        rigid_groups: groups of the take's markers that are rigid and not on the body.
        requests: how a reviewer wants some samples to be filled.
    """
    is_editable = compute_editable_mask(take, options)
    is_wanted = ~is_inlier & is_editable
    body_estimate = estimate_from_body(take, is_inlier, body) if body else None
    if body_estimate is not None and not is_partial_body:
        estimate = estimate_missing_samples(take, is_inlier, body_estimate)
        estimate = join_gap_estimates(estimate, np.where(is_inlier[..., None], take.markers, np.nan), take.rate)
    else:
        estimate = estimate_without_body(take.markers, is_inlier, take.rate)
        if body_estimate is not None:
            estimate = combine_with_partial_body(estimate, body_estimate, ~is_inlier)
    if rigid_groups:
        in_groups = estimate_from_rigid_groups(np.where(is_inlier[..., None], take.markers, np.nan), rigid_groups)
        estimate = prefer_rigid_groups(estimate, in_groups, ~is_inlier)
    if requests:
        inliers = np.where(is_inlier[..., None], take.markers, np.nan)
        estimate = use_requested_methods(estimate, requests, inliers, body_estimate, take.rate)
    markers, sd, method = estimate
    reasons = explain_unfilled_samples(take, is_wanted, gap_durations_s, sd, options)
    reasons = explain_unfilled_ends(reasons, is_wanted, ends, sd, options)
    reasons = explain_requested_fills(reasons, requests, is_wanted & np.isnan(sd))
    is_filled = is_wanted & (reasons == "")
    filled = np.where(is_filled[..., None], markers, np.where((is_wanted & ~is_filled)[..., None], np.nan, take.markers))
    after = take.replace_markers(filled, np.where(is_filled, sd, np.nan))
    return FilledTake(after, list_unfilled_runs(after, take, is_editable, reasons), np.where(is_filled, method, -1))


def join_gap_estimates(estimate: MarkerEstimate, markers: Float[np.ndarray, "T M 3"], rate: float) -> MarkerEstimate:
    """Combine estimates of the whole take with estimates of single gaps, in the gaps where the former are uncertain.

    The estimates of a single gap are weighted by their errors in stretches of its length, hidden where the marker is visible.
    If the take has no such stretch they are uncertain too, and the body has more weight.

    estimate  from all methods over the whole take
    markers   in metres, NaN if not visible or an outlier
    rate      frame rate in Hz
    """
    is_missing = np.isnan(markers[..., 0])
    is_settled = find_gaps_below(estimate.sd, is_missing, MAX_SETTLED_GAP_SD_M)
    if is_settled[is_missing].all():
        return estimate
    settled_sd = np.where(is_settled, estimate.sd, np.nan)
    settled = estimate._replace(position=np.where(is_settled[..., None], estimate.position, np.nan), sd=settled_sd)
    in_gaps, _, _ = estimate_gaps(markers, settled, rate, measure_speed_limit(markers, rate))
    sd = in_gaps.sd * compute_gap_inflation(~is_missing)
    is_precise = find_gaps_below(in_gaps.sd, is_missing & ~is_settled, MAX_GAP_ESTIMATE_SD_M)
    is_used = ~is_settled & (is_precise | np.isnan(estimate.sd))
    in_gaps = in_gaps._replace(sd=np.where(is_used, sd, np.nan))
    combined, ratio = combine_estimates([estimate.select(is_missing), in_gaps.select(is_missing)])
    return combined._replace(sd=np.maximum(combined.sd * ratio, MIN_COMBINED_SD_M)).expand(is_missing)


def find_gaps_below(
    sd: Float[np.ndarray, "T M"], is_missing: Bool[np.ndarray, "T M"], max_sd_m: float
) -> Bool[np.ndarray, "T M"]:
    """Return the samples of the gaps in which a standard deviation is at most `max_sd_m` throughout."""
    is_below = is_missing & (sd <= max_sd_m)
    for m in np.flatnonzero((is_missing & ~is_below).any(0)):
        for first, last in find_runs(is_missing[:, m]):
            is_below[first : last + 1, m] &= is_below[first : last + 1, m].all()
    return is_below


def estimate_from_body(take: Take, is_inlier: Bool[np.ndarray, "T M"], body: BodyFit) -> MarkerEstimate:
    """Estimate the take's missing samples from the solved body."""
    columns = body.marker_columns
    positions, sd = np.full(take.markers.shape, np.nan), np.full(take.visible.shape, np.nan)
    has_column = columns >= 0
    subject_take = take.select(columns, is_inlier)
    is_missing = ~is_inlier[:, columns] & has_column
    filled, filled_sd = marker_estimates.fill_from_body(
        subject_take.markers, is_missing, body.extended_subject, body.motion, take.rate
    )
    positions[:, columns[has_column]], sd[:, columns[has_column]] = filled[:, has_column], filled_sd[:, has_column]
    return build_marker_estimate(positions, sd, FillMethod.BODY)


def check_fill_options(take: Take, options: FillOptions, noun: str = "marker") -> None:
    """Raise TakeError if `keep` or `frames` name what the take does not have.

    Args:
        take: the take.
        options: the options to check.
        noun: "marker", or "joint" for an animation.
    """
    known = set(take.labels) | set(take.bare_labels)
    if unknown := [label for label in options.keep if label not in known]:
        known_labels = format_name_list(take.labels)
        raise TakeError(f"{take.name}: has no {noun} {format_name_list(unknown)} to keep; its {noun}s are {known_labels}.")
    if options.frames:
        first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
        start, stop = options.frames
        if start > stop:
            raise TakeError(f"{take.name}: frames {start} to {stop}: the first must not come after the last.")
        if stop < first or start > last:
            raise TakeError(f"{take.name}: frames {start} to {stop} are not in the take, which has {first} to {last}.")


def compute_gap_durations(is_inlier: Bool[np.ndarray, "T M"], rate: float) -> Float[np.ndarray, "T M"]:
    """Return the duration in seconds of the gap that each sample lies in, 0 for inliers. `rate` is in hertz."""
    durations_s = np.zeros(is_inlier.shape)
    for m in np.flatnonzero(~is_inlier.all(0)):
        for first, last in find_runs(~is_inlier[:, m]):
            durations_s[first : last + 1, m] = (last - first + 1) / rate
    return durations_s


def explain_unfilled_samples(
    take: Take,
    is_wanted: Bool[np.ndarray, "T M"],
    gap_durations_s: Float[np.ndarray, "T M"],
    sd_m: Float[np.ndarray, "T M"],
    options: FillOptions,
) -> Shaped[np.ndarray, "T M"]:
    """Return the reason why each wanted sample is not filled, "" for samples that are filled (object array)."""
    reasons = np.full(is_wanted.shape, "", object)
    reasons[is_wanted & np.isnan(sd_m)] = "the markers that move with it are visible for too short a time to estimate it"
    is_uncertain = is_wanted & (sd_m > options.max_sd_m)
    reasons[is_uncertain] = f"its predicted standard deviation exceeds {options.max_sd_m * 1e3:.0f} mm"
    reasons[is_wanted & (gap_durations_s > options.max_gap_s)] = f"the gap is longer than {options.max_gap_s:g} s"
    reasons[is_wanted & ~take.visible.any(0)] = "the marker is never visible in this take"
    return reasons


def find_ends(is_measured: Bool[np.ndarray, "T M"]) -> Int8[np.ndarray, "T M"]:
    """Return -1 for the samples before each marker is first measured, 1 for those after it is last measured, 0 for the others.

    A marker that is never measured has no ends.
    """
    is_begun = np.logical_or.accumulate(is_measured, axis=0)
    is_ended = ~np.logical_or.accumulate(is_measured[::-1], axis=0)[::-1]
    return np.where(is_measured.any(0), is_ended.astype(np.int8) - ~is_begun, 0).astype(np.int8)


def explain_unfilled_ends(
    reasons: Shaped[np.ndarray, "T M"],
    is_wanted: Bool[np.ndarray, "T M"],
    ends: Int8[np.ndarray, "T M"],
    sd_m: Float[np.ndarray, "T M"],
    options: FillOptions,
) -> Shaped[np.ndarray, "T M"]:
    """Return the reasons with those of the samples at a marker's ends that are too uncertain. `ends` is from `find_ends`.

    A motion between two measurements is interpolated, and its errors are bounded. Beyond them it is extrapolated.
    """
    limit_m = options.max_end_sd_m
    rule = f", where it is predicted worse than {limit_m * 1e3:g} mm (--max-end-sd)" if limit_m else " (--max-end-sd 0)"
    is_left = is_wanted & ((sd_m > limit_m) | (limit_m == 0.0))
    is_left &= (reasons == "") | (sd_m > options.max_sd_m)
    before, after = (f"{words} measured{rule}" for words in ("before the marker is first", "after the marker is last"))
    return np.where(is_left & (ends < 0), before, np.where(is_left & (ends > 0), after, reasons))


def list_unfilled_runs(
    after: Take, before: Take, is_editable: Bool[np.ndarray, "T M"], reasons: Shaped[np.ndarray, "T M"]
) -> tuple[UnfilledRun, ...]:
    """Return the runs of samples that are still missing, each with one reason."""
    unfilled: list[UnfilledRun] = []
    for m in range(len(after.labels)):
        for first, last in find_runs(~after.visible[:, m]):
            given = [reason for reason in dict.fromkeys(reasons[first : last + 1, m]) if reason]
            reason = "; ".join(given) or "excluded from editing by --keep or --frames"
            if not before.visible[:, m].any():
                reason = "the marker is never visible in this take"
            unfilled.append(UnfilledRun(m, first, last, reason))
    return tuple(unfilled)

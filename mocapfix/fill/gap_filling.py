"""The fill: every missing or faulty sample gets its most precise estimate, or stays empty with a reason.

With a solved body a sample has up to four estimates: the marker's place on the body plus the interpolated residual at the edges
of the gap, its rigid cluster, a spline, and a Gaussian process over all markers.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped

from mocapfix.errors import TakeError, format_name_list
from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.fill_methods import (
    FillMethod,
    FillRequest,
    MarkerEstimate,
    build_marker_estimate,
    explain_requested_fills,
    find_impossible_speeds,
    locate_requested_fills,
    measure_fastest_speed,
    measure_speed_limit,
    use_requested_methods,
)
from mocapfix.fill.gap_estimates import estimate_gaps, estimate_without_body
from mocapfix.fill.marker_processes import fill_from_gaussian_process
from mocapfix.fill.rigid_group_fill import estimate_from_rigid_groups, prefer_rigid_groups
from mocapfix.fill.spline_fill import MIN_FILL_SD_M, fill_with_splines
from mocapfix.fill.weighted_estimates import combine_estimates
from mocapfix.io.changes_file import Correction
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.changes import Filled, UnfilledRun, compute_editable_mask, expand_unfilled_reasons
from mocapfix.model.detected import Detected
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import SAMPLE_NOISE_M, Take
from mocapfix.options import FillOptions
from mocapfix.solve import kinematics
from mocapfix.stats.gaussian_process import interpolate_residual
from mocapfix.stats.marker_distances import MIN_GROUP_MARKERS, RigidGroup
from mocapfix.stats.sequences import find_runs

GAUSSIAN_PROCESS_CORRELATION = 0.8
"""Correlation of the errors of the Gaussian process and the other estimates: where it is used, they rely on the same markers."""
MAX_SPLINE_GAP_S = 0.5  # duration of the longest gap that is filled by splines
SETTLED_SPLINE_SD_M = 0.001  # standard deviation of a spline below which its samples are used as known ones by the clusters
PARTIAL_BODY_SD_RATIO = 2.0
"""Ratio of errors to predicted standard deviations where a body has few markers, or a set that was learned from the take."""


def combine_with_partial_body(
    estimate: MarkerEstimate, body_estimate: MarkerEstimate, is_missing: Bool[np.ndarray, "T M"]
) -> MarkerEstimate:
    """Return the combination of the estimates without a body and those from a body that few markers determine.

    estimate       the estimate without a body, as `estimate_without_body` returns it
    body_estimate  the estimate from the solved body
    is_missing     samples that are estimated
    """
    widened = body_estimate._replace(sd=body_estimate.sd * PARTIAL_BODY_SD_RATIO)
    combined, ratio = combine_estimates([estimate.select(is_missing), widened.select(is_missing)])
    return combined._replace(sd=np.maximum(combined.sd * ratio, MIN_FILL_SD_M)).expand(is_missing)


def estimate_missing_samples(
    take: Take, is_inlier: Bool[np.ndarray, "T M"], body_estimate: MarkerEstimate | None = None
) -> MarkerEstimate:
    """Return the most precise estimate of all samples that are missing or no inliers.

    is_inlier      samples that are used
    body_estimate  the estimate from the solved body, if there is one
    """
    markers = np.where(is_inlier[..., None], take.markers, np.nan)
    if is_inlier.all():
        nothing = np.full(is_inlier.shape, np.nan)
        return build_marker_estimate(np.full(markers.shape, np.nan), nothing, FillMethod.SPLINE)
    context = _FillContext(markers, take.rate, np.isnan(markers[..., 0]), measure_fastest_speed(markers, take.rate))
    combined, ratio = combine_estimates(iterate_estimates(context, body_estimate))
    others = combined.expand(context.is_missing)
    filled = fill_from_gaussian_process(markers, others.position, others.sd, take.rate)
    del others
    process = _select_plausible(filled, is_inlier, context, FillMethod.GAUSSIAN_PROCESS)
    del filled
    estimate, process_ratio = combine_estimates([combined, process], GAUSSIAN_PROCESS_CORRELATION)
    estimate = estimate._replace(sd=np.maximum(estimate.sd * ratio * process_ratio, MIN_FILL_SD_M))
    return estimate.expand(context.is_missing)


class _FillContext(NamedTuple):
    """What the estimates have in common."""

    markers: np.ndarray  # (T, M, 3) m, NaN if not visible or an outlier
    rate: float  # frame rate in Hz
    is_missing: np.ndarray  # (T, M) the samples that are NaN
    fastest_speed: float | None  # of the visible motion, in m/s; None if nothing is visible in two frames in a row


def iterate_estimates(context: _FillContext, body_estimate: MarkerEstimate | None) -> Iterator[MarkerEstimate]:
    """Yield the estimates of the missing samples from splines, clusters and the body."""
    markers, rate = context.markers, context.rate
    position, sd = fill_with_splines(markers, rate, MAX_SPLINE_GAP_S)
    spline = build_marker_estimate(position, sd, FillMethod.SPLINE).select(context.is_missing)
    del position, sd
    with_splines = markers.copy()
    with_splines[context.is_missing] = np.where((spline.sd <= SETTLED_SPLINE_SD_M)[:, None], spline.position, np.nan)
    yield spline
    yield _select_plausible(fill_from_clusters(with_splines, rate), ~context.is_missing, context, FillMethod.CLUSTER)
    if body_estimate:
        yield body_estimate.select(context.is_missing)


def _select_plausible(
    filled: tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]],
    is_learned: Bool[np.ndarray, "T M"],
    context: _FillContext,
    method: FillMethod,
) -> MarkerEstimate:
    """Return the estimates of the missing samples from a method that has learned from others, none near impossible speeds."""
    is_missing, path = context.is_missing, context.markers.copy()
    position, sd = (values[is_missing] for values in filled)
    path[is_missing] = position
    is_impossible = find_impossible_speeds(path, ~is_missing, context.rate, context.fastest_speed)[is_missing]
    sd = np.where(is_impossible, np.nan, sd) * compute_gap_inflation(is_learned)[is_missing]
    return build_marker_estimate(position, sd, method)


def compute_gap_inflation(is_inlier: Bool[np.ndarray, "T M"]) -> Float[np.ndarray, "T M"]:
    """Return the factor by which the standard deviation of a learned estimate is underestimated.

    Such an estimate is learned from the frames in which the marker is visible. The longer a gap is relative to these, the more of
    it differs from what was learned.
    """
    factor = np.ones(is_inlier.shape)
    for m in range(is_inlier.shape[1]):
        visible_count = max(is_inlier[:, m].sum(), 1)
        for first, last in find_runs(~is_inlier[:, m]):
            factor[first : last + 1, m] = 1 + 2 * (last - first + 1) / visible_count
    return factor


BODY_RESIDUAL_FADE_S = 0.2  # time scale of the correlation of a marker's residual
BODY_RESIDUAL_REACH_S = 0.3  # time on either side of a gap that is used
MIN_BODY_RESIDUAL_M = 0.002  # smallest standard deviation of the residual
MIN_BODY_FILL_SD_M = 0.0005  # smallest standard deviation of a fill
MAX_EDGE_RESIDUAL_M = 0.05
"""Residual of a sample above which it may be unusable as the edge of a gap; it must also exceed MAX_EDGE_RESIDUAL_RATIO."""
MAX_EDGE_RESIDUAL_RATIO = 4.0  # the same relative to the marker's median residual


def fill_from_body(
    markers: Float[np.ndarray, "T K 3"], is_wanted: Bool[np.ndarray, "T K"], subject: Subject, motion: Motion, rate: float
) -> tuple[Float[np.ndarray, "T K 3"], Float[np.ndarray, "T K"]]:
    """Return positions of the wanted samples in metres, and their standard deviations per axis; NaN elsewhere.

    In a gap the residual consists of the marker's motion relative to its joint and of the error of a pose that was solved without
    this marker. Both are known at the edges of the gap, and decay with the correlation of the residual.

    markers  in metres in the subject's order, NaN if not visible or an outlier
    """
    joint_positions, joint_rotations = kinematics.compute_world_poses(subject.skeleton, motion)
    filled, sd = np.full(markers.shape, np.nan), np.full(is_wanted.shape, np.nan)
    for k, joint in enumerate(subject.joints):
        wanted = is_wanted[:, k]
        if not wanted.any():
            continue
        rotation = joint_rotations[:, joint]
        predicted = joint_positions[:, joint] + rotation @ subject.marker_offsets[k]
        residual = np.einsum("tba,tb->ta", rotation, markers[:, k] - predicted)
        distance = np.linalg.norm(residual, axis=1)
        if (is_known := ~np.isnan(distance)).any():
            median = float(np.median(distance[is_known]))
            residual[distance > max(MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO * median)] = np.nan
        interpolated, variance, power = interpolate_residual(
            residual,
            wanted,
            rate,
            time_scale_s=BODY_RESIDUAL_FADE_S,
            margin_s=BODY_RESIDUAL_REACH_S,
            noise_sd=SAMPLE_NOISE_M,
            min_sd=MIN_BODY_RESIDUAL_M,
        )
        filled[wanted, k] = predicted[wanted] + np.einsum("tab,tb->ta", rotation[wanted], interpolated[wanted])
        total_variance = variance[wanted] * (1 + motion.marker_sd[wanted, k] ** 2 / power)
        sd[wanted, k] = np.sqrt(np.maximum(total_variance, MIN_BODY_FILL_SD_M**2))
    return filled, sd


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
    return combined._replace(sd=np.maximum(combined.sd * ratio, MIN_FILL_SD_M)).expand(is_missing)


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
    filled, filled_sd = fill_from_body(subject_take.markers, is_missing, body.extended_subject, body.motion, take.rate)
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

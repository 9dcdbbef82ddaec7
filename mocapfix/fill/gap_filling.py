"""The fill: every missing or faulty sample gets its estimate, or stays empty with a reason.

The estimates and their weights: `gap_estimates`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped

from mocapfix.fill.gap_estimates import FillRequest, estimate_missing_samples
from mocapfix.fill.gap_windows import FillMethod
from mocapfix.io.changes_file import EXCLUDED_REASON, Correction
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.changes import KEYS_METHOD, Filled, compute_editable_mask
from mocapfix.model.detected import Detected
from mocapfix.model.take import Take, TakePart
from mocapfix.options import FillOptions
from mocapfix.stats.marker_distances import MIN_GROUP_MARKERS, RigidGroup
from mocapfix.stats.sequences import find_runs

NEVER_VISIBLE_REASON = "the marker is never visible in this take"
EMPTY_REASON = "left empty in review"
NO_ESTIMATE_REASON = "the method that was requested in review ({method}) gives no estimate"


def fill_gaps(
    detected: Detected,
    body: BodyFit | None,
    props: Mapping[str, Sequence[str]],
    alternatives: Sequence[Sequence[Correction]],
    options: FillOptions,
    hands: Sequence[BodyFit] = (),
) -> Iterator[Filled]:
    """Fill a take's missing and faulty samples, with each of some lists of corrections.

    Fills of other programs stay as they are (unless they were detected as faulty), and labels that only name fragments of other
    markers are not filled.

    Args:
        body: the body that is solved from it, with the motion from which lost markers are filled.
        props: the labels of each prop that the marker set names.
        alternatives: those of a reviewer, who may request the fills of samples; the lists differ in requested methods only.
        hands: the solved hands, as bodies that carry the finger markers.
    """
    take, inliers, epochs = detected.take, detected.inlier_mask, detected.epochs
    gap_durations_s = compute_gap_durations(inliers, take.rate, take.part)[:, epochs.column_marker]
    groups = find_rigid_groups_outside(detected, body, props)
    # while a marker slides it is at neither position, yet its samples show most of where it is in a gap between them
    is_shown = inliers[:, epochs.column_marker] & epochs.is_near
    requests = [
        [  # for every column of a marker that moved
            FillRequest(int(column), each.first, each.last, each.entry.method)
            for each in corrections
            if each.entry.method is not None
            for column in np.flatnonzero(epochs.column_marker == each.markers[0])
        ]
        for corrections in alternatives
    ]
    is_kept = take.visible & ~take.measured
    is_kept[:, list(detected.donor_markers)] = True
    is_editable = compute_editable_mask(take, options)
    descriptions = np.array([*(method.description for method in FillMethod), ""], object)
    of_take = [replace(each, markers=tuple(dict.fromkeys(epochs.column_marker[list(each.markers)].tolist()))) for each in groups]
    body_markers = detected.place_on_body(body) if body else None
    fills = fill_take(
        epochs.take.replace_markers(np.where(is_shown[..., None], take.markers[:, epochs.column_marker], epochs.take.markers)),
        is_shown,
        gap_durations_s,
        find_ends(inliers, take.part)[:, epochs.column_marker],
        body,
        options,
        rigid_groups=groups,
        hands=hands,
        alternatives=requests,
    )
    for corrections, (filled, empty_reasons, method_numbers) in zip(alternatives, fills, strict=True):
        markers = np.where(is_kept[..., None], take.markers, epochs.merge_columns(filled.markers))
        sd_m = np.where(is_kept, np.nan, epochs.merge_columns(filled.estimated_sd))
        methods = np.where(is_kept, "", epochs.merge_columns(descriptions[method_numbers]))
        reasons = epochs.merge_columns(empty_reasons)
        for each in (correction for correction in corrections if correction.entry.points):
            m, frames = each.markers[0], np.arange(each.first, each.last + 1)
            positions = interpolate_keys(each, markers[:, m], take.first_frame)
            samples = frames[is_set := ~np.isnan(positions[:, 0]) & is_editable[frames, m]], m
            markers[samples], methods[samples], reasons[samples] = positions[is_set], KEYS_METHOD, ""
            sd_m[samples] = np.fmin(np.nan_to_num(sd_m[samples], nan=np.inf), options.max_sd_m)  # as of the estimate in its place
        yield Filled(detected, take.replace_markers(markers, sd_m), reasons, methods, body_markers, tuple(of_take))


def interpolate_keys(keys: Correction, path: Float[np.ndarray, "T 3"], first_frame: int) -> Float[np.ndarray, "n 3"]:
    """Return positions in metres of a spline through points and on to the samples of a path beside them, NaN beyond both."""
    from scipy.interpolate import CubicHermiteSpline  # slow to import

    beside = np.array([keys.first - 2, keys.first - 1, keys.last + 1, keys.last + 2])
    beside = beside[(beside >= 0) & (beside < len(path))]
    beside = beside[~np.isnan(path[beside, 0])]
    points = np.array(keys.entry.points)
    times, order = np.unique(np.r_[points[:, 0] - first_frame, beside], return_index=True)
    knots, numbers = np.concatenate([points[:, 1:] / 1e3, path[beside]])[order], np.arange(len(times))
    after, before = np.minimum(numbers + 1, len(times) - 1), np.maximum(numbers - 1, 0)
    slopes = (knots[after] - knots[before]) / (times[after] - times[before])[:, None]
    return CubicHermiteSpline(times, knots, slopes, extrapolate=False)(np.arange(keys.first, keys.last + 1))


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
    rigid_groups: Sequence[RigidGroup] = (),
    hands: Sequence[BodyFit] = (),
    alternatives: Sequence[Sequence[FillRequest]] = ((),),
) -> Iterator[tuple[Take, Shaped[np.ndarray, "T M"], Int[np.ndarray, "T M"]]]:
    """Fill or empty every sample that is not an inlier.

    Args:
        take: the take; its M columns are those that `body.marker_columns` points to.
        is_inlier: samples that are kept bit for bit.
        gap_durations_s: the duration of the gap of each sample, as `compute_gap_durations` returns it for the whole take.
        ends: the samples before a marker is first measured and after it is last measured, as `find_ends` returns them for the
            whole take.
        rigid_groups: groups of the take's markers that are rigid and not on the body.
        alternatives: how a reviewer wants some samples to be filled; lists that differ in their methods only.

    Yields:
        For each list the filled take; why each sample stays empty, "" for the others; and the FillMethod of each sample, -1 where
        it was not filled.
    """
    is_editable = compute_editable_mask(take, options)
    is_wanted = ~is_inlier & is_editable
    known = np.where(is_inlier[..., None], take.markers, np.nan)
    estimates = estimate_missing_samples(
        known, take.rate, body=body, rigid_groups=rigid_groups, hands=hands, alternatives=alternatives
    )
    for requests, (markers, sd, method) in zip(alternatives, estimates, strict=True):
        reasons = explain_unfilled_samples(take, is_wanted, gap_durations_s, sd, options)
        reasons = explain_unfilled_ends(reasons, is_wanted, ends, sd, options)
        reasons = explain_requested_fills(reasons, requests, is_wanted & np.isnan(sd))
        is_filled = is_wanted & (reasons == "")
        filled = np.where(is_filled[..., None], markers, np.where((is_wanted & ~is_filled)[..., None], np.nan, take.markers))
        after = take.replace_markers(filled, np.where(is_filled, sd, np.nan))
        reasons[~is_editable] = EXCLUDED_REASON
        reasons[:, ~take.is_ever_visible] = NEVER_VISIBLE_REASON
        yield after, np.where(after.visible, "", reasons), np.where(is_filled, method, -1)


def compute_gap_durations(
    is_inlier: Bool[np.ndarray, "T M"], rate: float, part: TakePart | None = None
) -> Float[np.ndarray, "T M"]:
    """Return the duration in seconds of the gap that each sample lies in, 0 for inliers. `rate` is in hertz.

    Args:
        part: the part of a longer take of which these are the samples: gaps go on beyond its ends.
    """
    durations_s, last_frame = np.zeros(is_inlier.shape), len(is_inlier) - 1
    beyond = np.zeros((2, is_inlier.shape[1]), int) if part is None else part.missing
    for m in np.flatnonzero(~is_inlier.all(0)):
        for first, last in find_runs(~is_inlier[:, m]):
            count = last - first + 1 + (first == 0) * beyond[0, m] + (last == last_frame) * beyond[1, m]
            durations_s[first : last + 1, m] = count / rate
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
    reasons[is_uncertain] = f"its predicted standard deviation exceeds {options.max_sd_m * 1e3:g} mm"
    reasons[is_wanted & (gap_durations_s > options.max_gap_s)] = f"the gap is longer than {options.max_gap_s:g} s"
    reasons[is_wanted & ~take.is_ever_visible] = NEVER_VISIBLE_REASON
    return reasons


def find_ends(is_measured: Bool[np.ndarray, "T M"], part: TakePart | None = None) -> Int8[np.ndarray, "T M"]:
    """Return -1 for the samples before each marker is first measured, 1 for those after it is last measured, 0 for the others.

    A marker that is never measured has no ends.

    Args:
        part: the part of a longer take of which these are the samples: markers may be measured before and after it.
    """
    if part is not None:
        padded = np.concatenate([part.is_seen[:1], is_measured, part.is_seen[1:]])
        return find_ends(padded)[1:-1]
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


def explain_requested_fills(
    reasons: Shaped[np.ndarray, "T M"], requests: Sequence[FillRequest], is_without_estimate: Bool[np.ndarray, "T M"]
) -> Shaped[np.ndarray, "T M"]:
    """Return the reasons why samples stay empty, with those that follow from a request."""
    reasons = reasons.copy()
    for each in requests:
        reason = EMPTY_REASON if each.method == "empty" else NO_ESTIMATE_REASON.format(method=each.method)
        samples = slice(each.first, each.last + 1), each.column
        reasons[samples] = np.where(is_without_estimate[samples], reason, reasons[samples])
    return reasons

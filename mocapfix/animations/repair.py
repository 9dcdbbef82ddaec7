"""Repair of an animation's faults, keeping what each kind of fault leaves of the original motion, and which repairs are applied.

The methods are those of `repair_methods`; lost joints are inferred from neighbouring frames, from frames with a similar body
state and from a trained pose model (`solve.occluded_joints`). Such a method is not always better than interpolation between the
intact frames: a joint may rest, a limb may move unlike the rest of the take, and a pose model may not know the rig. Each predicts
its own error. Where the estimate differs from the interpolation by no more than that, it may as well be wrong, so the values are
interpolated (`is_different`). The error that is predicted for a lost joint may be too small. So the same damage is done to sound
frames elsewhere in the take, with similar motion before and after, and repaired by each method, and the one with the smallest
errors there is used in the fault (`choose_estimate`).

Applied are the repairs that the options allow and that are certain enough (`apply_repairs`); all else is unchanged.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial.transform import Rotation

from mocapfix.animations import repair_methods as methods
from mocapfix.animations.repair_methods import REPAIR_DESCRIPTIONS, FrameSpan, RepairMethod, SpanEstimate
from mocapfix.fill.gap_filling import compute_gap_durations, explain_unfilled_samples
from mocapfix.fill.gap_windows import find_stretches
from mocapfix.io.changes_file import ReviewedChange
from mocapfix.kernels import lie
from mocapfix.model import changes
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take, compute_joint_point_sd
from mocapfix.model.changes import Change, UnfilledRun, compute_editable_mask, find_unfilled_runs
from mocapfix.model.faults import Fault, Faults, build_fault_mask
from mocapfix.model.skeleton import compose_transforms, find_ancestor
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.solve.motion_prior import GapContext, combine_rotations, compute_combined_variance, compute_prediction_weight
from mocapfix.solve.occluded_joints import RECORDED_ROTATION_KERNEL, KnownMotion, infer_gap_joints
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.sequences import DENSE_TRAINING_MARGIN_S, find_runs, group_gaps

LOST_KINDS = ("gap", "stuck")  # fault kinds whose values carry no information
MAX_LOST_SHARE = 0.5  # of the joints that move; with more, the root is lost too
MIN_STEADY_FRAMES = 3  # frames without jitter that smoothing by the state of the body requires
EXACT_VARIANCE_RAD2 = 1e-8  # variance of rotations without a fault
MIN_JOINT_MOTION_RAD = 1e-3  # range of a rotation matrix's entries above which a joint counts as moving


class AnimationRepair(NamedTuple):
    """A repaired animation with N = J + 1 tracks: the rotations of J joints, and last the root position."""

    root_position: Float[np.ndarray, "T 3"]  # m
    local_rotations: Float[np.ndarray, "T J 3 3"]
    variance: Float[np.ndarray, "T N"]  # of repaired values, in rad^2 or m^2 per axis; 0 elsewhere
    method: Int[np.ndarray, "T N"]  # a RepairMethod for each value

    def get_track(self, n: int) -> np.ndarray:
        """Return a copy of a track: the rotations of a joint (T, 1, 3, 3) or the root position (T, 1, 3)."""
        return self.local_rotations[:, [n]] if n < self.local_rotations.shape[1] else self.root_position[:, None].copy()


def repair_animation(
    parents: Int[np.ndarray, " J"],
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    rotation_orders: Sequence[str],
    faults: Sequence[Fault],
    rate: float,
    conditioner: PriorConditioner | None = None,
) -> AnimationRepair:
    """Return the animation without its faults, which are as from `detect_pose_faults`.

    Positions (in metres) and rotations are NaN without a value; those that no fault names stay so. The conditioner has a pose
    model for this skeleton.
    """
    shape = (len(root_position), local_rotations.shape[1] + 1)
    if not faults:
        return AnimationRepair(root_position, local_rotations, np.zeros(shape), np.zeros(shape, int))
    is_lost = build_fault_mask([fault for fault in faults if fault.kind in LOST_KINDS], shape)
    is_finite = np.column_stack([np.isfinite(local_rotations).all((2, 3)), np.isfinite(root_position).all(1)])
    stays_missing = ~is_finite & ~is_lost
    is_lost |= stays_missing
    local_rotations = np.where(is_lost[:, :-1, None, None], np.eye(3), local_rotations)
    root_position = np.where(is_lost[:, -1:], 0.0, root_position)
    repair = AnimationRepair(root_position, local_rotations, np.zeros(shape), np.zeros(shape, int))
    is_faulty = build_fault_mask(faults, shape) | stays_missing
    for fault in sorted(faults, key=lambda fault: fault.last - fault.first):
        if fault.kind in ("pop", "flip", "spike"):
            _remove_offset(repair, fault, is_faulty, rotation_orders, rate)
            is_faulty[fault.frame_slice, fault.marker] = False
    moving_joints = np.flatnonzero(np.ptp(local_rotations, axis=0).max((1, 2)) > MIN_JOINT_MOTION_RAD)
    for fault in faults:
        if fault.kind == "jitter":
            _smooth_jitter(repair, fault, is_faulty, moving_joints, rate)
    is_body_lost = is_lost[:, moving_joints].sum(1) > MAX_LOST_SHARE * len(moving_joints)
    _infer_lost_joints(repair, parents, is_lost & ~is_body_lost[:, None], moving_joints, rate, conditioner)
    _interpolate_gaps(repair, parents, is_lost, is_body_lost, rate, conditioner)
    repair.local_rotations[stays_missing[:, :-1]], repair.root_position[stays_missing[:, -1]] = np.nan, np.nan
    repair.variance[stays_missing], repair.method[stays_missing] = 0.0, RepairMethod.UNCHANGED
    return repair


MAX_TRIALS = 4  # sound stretches in which the damage of a fault is repeated
MIN_TRIALS = 3  # sound stretches without which no other method is chosen
TRIAL_MARGIN_S = 0.1  # sound time on either side of a stretch
NEGLIGIBLE_DIFFERENCE = 2e-4  # radians or metres; at the end of a limb of 0.5 m a tenth of a millimetre
"""A difference from the interpolation that counts as none; it is added to errors before they are compared."""
MIN_DIFFERENCE_RATIO = 0.7
"""Predicted errors by which an estimate has to differ from the interpolation. Of 360 joints and limbs lost in fifteen motions
108 differed by less, and half of their estimates were worse than interpolated; of 69 that differed by up to twice as much 7 %,
of the others 2 %."""
CLEAR_DIFFERENCE_RATIO = 1.5
"""The same at which no trial is needed: of 117 pops, flips and bursts of jitter 3 % were then worse, of 63 others 41 %."""
CONTEXT_S = 0.3  # time on either side over which the motion about a fault is compared with that about a stretch
REST = 2e-3  # radians or metres, or these a second, below which differences of motion do not count
MAX_TRACKWISE_GAP_S = 0.04  # duration of a gap of the whole body up to which its tracks are interpolated alone
CAUTION = 0.5
"""Standard deviations of the logarithm of a method's error over that of the interpolation that are added to its mean."""


def choose_estimate(
    estimate: Callable[[FrameSpan], list[SpanEstimate]],
    track: np.ndarray,
    parents: Int[np.ndarray, " L"],
    is_usable: Bool[np.ndarray, " T"],
    span: FrameSpan,
) -> SpanEstimate | None:
    """Return the estimate over a span whose method has the smallest errors in sound stretches with similar motion about them.

    It is the interpolation if the last estimate hardly differs from it, compared with the error that is predicted for it.

    Args:
        estimate: Returns estimates over a span, the interpolation first; over other spans than the fault's, of the same damage.
        track: Rotations (T, L, 3, 3) or positions (T, L, 3), correct where usable.
        parents: Index among the L joints of the nearest one above each, -1 if there is none.
        is_usable: The frames that are sound.
        span: The fault.
    """
    estimates = estimate(span)
    if len(estimates) < 2:
        return estimates[0] if estimates else None
    is_same = not is_different(estimates[-1], estimates[0].values, parents, MIN_DIFFERENCE_RATIO)
    if is_same and len(span.frames) <= MAX_TRACKWISE_GAP_S * span.rate:
        return estimates[0]
    errors, predicted, weights = list[list[float]](), list[list[float]](), list[float]()
    for stretch, weight in find_similar_stretches(track, is_usable, span):
        tried = estimate(stretch)
        if len(tried) == len(estimates):
            errors.append([_compare(each.values, track[stretch.frames], parents) + NEGLIGIBLE_DIFFERENCE for each in tried])
            predicted.append([3 * float(each.variance.mean()) + NEGLIGIBLE_DIFFERENCE**2 for each in tried])
            weights.append(weight)
    if len(errors) < MIN_TRIALS:
        return estimates[0 if is_same else -1]
    error_log = np.log(np.array(errors))
    ratio_log = error_log - error_log[:, :1]
    mean = np.average(ratio_log, axis=0, weights=weights)
    sd = np.sqrt(np.average((ratio_log - mean) ** 2, axis=0, weights=weights))
    best = 0 if is_same else int(np.argmin(mean + CAUTION * sd))
    squares, expected = (np.average(each, axis=0, weights=weights)[best] for each in (np.square(errors), np.array(predicted)))
    return estimates[best]._replace(variance=estimates[best].variance * squares / expected)


def is_different(estimate: SpanEstimate, interpolated: np.ndarray, parents: Int[np.ndarray, " L"], ratio: float) -> bool:
    """Return whether an estimate differs from interpolated values by more than `ratio` times its predicted error."""
    error = np.sqrt(3 * estimate.variance.mean())
    return _compare(estimate.values, interpolated, parents) > max(NEGLIGIBLE_DIFFERENCE, ratio * error)


def find_similar_stretches(
    track: np.ndarray, is_usable: Bool[np.ndarray, " T"], span: FrameSpan
) -> list[tuple[FrameSpan, float]]:
    """Return the sound stretches about which rotations or positions (T, L, ...) move most as they do about a span.

    What counts are the speeds before and after it, and how far apart the frames beside it are. With each stretch its weight is
    returned: the smaller over the larger of each, multiplied.
    """
    margin, reach = (max(1, round(seconds * span.rate)) for seconds in (TRIAL_MARGIN_S, CONTEXT_S))
    length, starts = find_stretches(is_usable, span.last - span.first + 1, margin, margin)
    is_step = is_usable[1:] & is_usable[:-1]
    steps = np.where(is_step, _measure_distances(track[1:], track[:-1]), 0.0)
    moved, known = (np.r_[0.0, np.cumsum(each)] for each in (steps, is_step))

    def describe(first: Int[np.ndarray, " S"], last: Int[np.ndarray, " S"]) -> Float[np.ndarray, "3 S"]:
        before, after = np.maximum(first - 1, 0), np.minimum(last + 1, len(track) - 1)
        edges = (np.maximum(before - reach, 0), before), (after, np.minimum(after + reach, len(track) - 1))
        speeds = [span.rate * (moved[b] - moved[a]) / np.maximum(known[b] - known[a], 1) for a, b in edges]
        return np.log(np.stack([*speeds, _measure_distances(track[before], track[after])]) + REST)

    own = describe(np.array([span.first]), np.array([span.last]))
    difference, stretches = np.abs(describe(starts, starts + length - 1) - own).sum(0), list[tuple[FrameSpan, float]]()
    while len(stretches) < MAX_TRIALS and np.isfinite(difference).any():
        first = int(starts[difference.argmin()])
        stretches.append((FrameSpan(first, first + length - 1, span.rate), float(np.exp(-difference.min()))))
        difference[np.abs(starts - first) < length + margin] = np.inf
    return stretches


def _measure_distances(values: np.ndarray, others: np.ndarray) -> Float[np.ndarray, " N"]:
    """Return the mean distances over L tracks of rotations (N, L, 3, 3), in radians if small, or positions (N, L, 3)."""
    axes, size = ((2, 3), np.sqrt(2)) if values.ndim == 4 else (2, 1.0)
    return np.sqrt(((values - others) ** 2).sum(axes)).mean(1) / size


def _compare(values: np.ndarray, others: np.ndarray, parents: Int[np.ndarray, " L"]) -> float:
    """Return the mean distance of positions, or of the directions of joints that carry each other, in metres or radians."""
    if values.ndim == 4:
        no_offsets = np.zeros(values.shape[:3])
        values, others = (compose_transforms(parents, no_offsets, each)[1] for each in (values, others))
    return float(_measure_distances(values, others).mean())


def _interpolate_tracks(track: np.ndarray, is_known: Bool[np.ndarray, "T L"], span: FrameSpan) -> list[SpanEstimate]:
    """Return the interpolations of rotations (T, L, 3, 3) or positions (T, L, 3): linear and by a process in time.

    Returns an empty list if a track is not known near the span.
    """
    linear, smooth, variances = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for n in range(track.shape[1]):
        context = methods.find_context_frames(is_known[:, n], span, round(methods.INTERPOLATION_CONTEXT_S * span.rate))
        if not len(context):
            return []
        interpolate = methods.interpolate_values if track.ndim == 3 else methods.interpolate_rotations
        values, variance = interpolate(track[context, n], context, span)
        linear.append(methods.interpolate_linearly(track[:, n], is_known[:, n], span))
        smooth.append(values)
        variances.append(variance)
    variance = np.stack(variances, axis=1)
    return [SpanEstimate(RepairMethod.GAP_INTERPOLATED, np.stack(values, axis=1), variance) for values in (linear, smooth)]


def _store(repair: AnimationRepair, estimate: SpanEstimate | None, tracks: np.ndarray | list[int], span: FrameSpan) -> None:
    """Write an estimate of tracks over a span."""
    if estimate is None:
        return
    frames = slice(span.first, span.last + 1)
    if estimate.values.ndim == 3:
        repair.root_position[frames] = estimate.values[:, 0]
    else:
        repair.local_rotations[frames, tracks] = estimate.values
    repair.variance[frames, tracks], repair.method[frames, tracks] = estimate.variance, estimate.method


def _remove_offset(
    repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, rotation_orders: Sequence[str], rate: float
) -> None:
    """Remove the offset of a pop, flip or spike, in place."""
    n, is_sound, span = fault.marker, ~is_faulty[:, fault.marker], FrameSpan(fault.first, fault.last, rate)
    track = repair.get_track(n)
    if track.ndim == 3:
        values, variance = methods.remove_position_offset(track[:, 0], is_sound, span)
    else:
        joint = lie.extract_joint_quaternions(track, 0, is_sound)
        corrected, variance = methods.remove_rotation_offset(joint, is_sound, span, rotation_orders[n])
        values = Rotation.from_quat(corrected).as_matrix()
    own = SpanEstimate(RepairMethod.OFFSET_REMOVED, values[:, None], np.full((len(values), 1), variance))
    _store_clear(repair, own, track, is_sound, n, span)


def _smooth_jitter(repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, moving_joints: np.ndarray, rate: float) -> None:
    """Smooth the jitter of a track, in place: of the root, or where few frames are sound, by its own motion alone."""
    n, frames, span = fault.marker, fault.frame_slice, FrameSpan(fault.first, fault.last, rate)
    track, is_sound = repair.get_track(n), ~is_faulty[:, n]
    is_usable = (moving_joints > 0) & (moving_joints != n) & ~is_faulty[frames][:, moving_joints].any(0)
    other_joints = moving_joints[is_usable]
    is_steady = is_sound & ~is_faulty[:, other_joints].any(1)
    if n in (0, repair.local_rotations.shape[1]) or is_steady.sum() < MIN_STEADY_FRAMES:
        _store_clear(repair, methods.smooth_own_jitter(track, is_sound, span, fault.severity), track, is_sound, n, span)
        return
    joint = lie.extract_joint_quaternions(track, 0, np.ones(len(track), bool))
    poses = repair.root_position, repair.local_rotations
    smoothed, variance = methods.smooth_joint_jitter(*poses, joint, other_joints, is_steady, span, fault.severity)
    values = Rotation.from_quat(smoothed).as_matrix()[:, None]
    _store_clear(repair, SpanEstimate(RepairMethod.JITTER_SMOOTHED, values, variance[:, None]), track, is_sound, n, span)


def _store_clear(
    repair: AnimationRepair, own: SpanEstimate, track: np.ndarray, is_sound: Bool[np.ndarray, " T"], n: int, span: FrameSpan
) -> None:
    """Write the estimate of track n over a span if it clearly differs from the interpolation, which else is written."""
    interpolated = list[SpanEstimate]()
    if is_sound.any():
        line = methods.interpolate_linearly(track[:, 0], is_sound, span)[:, None]
        if not is_different(own, line, np.array([-1]), CLEAR_DIFFERENCE_RATIO):
            interpolated = _interpolate_tracks(track, is_sound[:, None], span)
    _store(repair, interpolated[0] if interpolated else own, [n], span)


def _infer_lost_joints(
    repair: AnimationRepair,
    parents: Int[np.ndarray, " J"],
    is_lost: np.ndarray,
    moving_joints: np.ndarray,
    rate: float,
    conditioner: PriorConditioner | None,
) -> None:
    """Infer lost joints (T, N) below the root from the rest of the body, in place."""
    is_unobserved = is_lost[:, :-1].copy()
    is_unobserved[:, 0] = False
    exact = np.full(is_unobserved.shape, EXACT_VARIANCE_RAD2)
    joints = moving_joints[moving_joints > 0]
    given = KnownMotion(repair.root_position, repair.local_rotations.copy(), exact, is_unobserved, joints, rate)
    has_body, margin = given.has_body, round(DENSE_TRAINING_MARGIN_S * rate)

    def infer_gap(gap: tuple[tuple[int, int], Int[np.ndarray, " L"]]) -> None:
        span, lost = FrameSpan(*gap[0], rate), gap[1]
        is_hidden: np.ndarray = np.any(is_unobserved[span.frames], axis=0)
        used = np.union1d(joints[~is_hidden[joints]], lost)
        own_training = given.find_training_frames(span.first, span.last, lost)
        pose_predictions = dict[int, np.ndarray]()

        def estimate(at: FrameSpan) -> list[SpanEstimate]:
            hidden = is_unobserved.copy()
            hidden[at.frames] |= is_hidden if at != span else False
            motion, around = given._replace(is_unobserved=hidden), np.arange(at.first - margin, at.last + margin + 1)
            near = np.intersect1d(motion.find_training_frames(at.first, at.last, lost), around)
            training = np.union1d(near, np.setdiff1d(own_training, around))  # the pose model is evaluated once for far frames
            inferred = infer_gap_joints(
                motion, at.first, at.last, lost,
                training=training, kernel=RECORDED_ROTATION_KERNEL, conditioner=conditioner, pose_predictions=pose_predictions,
            )  # fmt: skip
            interpolated = _interpolate_tracks(given.local_rotations[:, lost], ~hidden[:, lost], at) if inferred else []
            return [*interpolated, *(SpanEstimate(RepairMethod.JOINT_INFERRED, *each[:2]) for each in inferred)]

        is_mine = np.isin(np.arange(len(parents)), lost)
        above = [find_ancestor(joint, parents, is_mine) for joint in lost.tolist()]
        own_parents = np.array([lost.tolist().index(joint) if joint >= 0 else -1 for joint in above])
        is_usable = has_body & ~is_unobserved[:, used].any(1)
        _store(repair, choose_estimate(estimate, given.local_rotations[:, lost], own_parents, is_usable, span), lost, span)

    run_in_parallel(infer_gap, group_gaps(is_unobserved & has_body[:, None]).items())


def _interpolate_gaps(
    repair: AnimationRepair,
    parents: np.ndarray,
    is_lost: np.ndarray,
    is_body_lost: np.ndarray,
    rate: float,
    conditioner: PriorConditioner | None,
) -> None:
    """Interpolate lost values (T, N) that are not yet repaired, of the whole body or track by track, in place."""
    remaining = is_lost & (repair.method == RepairMethod.UNCHANGED)
    is_known, is_body_lost = np.logical_not(is_lost.any(axis=1)), is_body_lost.copy()
    for first, last in find_runs(is_body_lost) if np.any(is_known) else ():
        if last - first + 1 <= MAX_TRACKWISE_GAP_S * rate:
            is_body_lost[first : last + 1] = False
            continue
        frames, mask = slice(first, last + 1), remaining[first : last + 1]
        poses = repair.root_position, repair.local_rotations
        body = methods.interpolate_body(parents, *poses, is_known, FrameSpan(first, last, rate))
        if conditioner:
            context = GapContext(*poses, ~is_lost[:, :-1] & ~is_lost[:, -1:], first, last, rate)
            body = _combine_body(body, context, conditioner)
        repair.root_position[frames] = np.where(mask[:, -1:], body.root_position, repair.root_position[frames])
        repair.local_rotations[frames] = np.where(mask[:, :-1, None, None], body.local_rotations, repair.local_rotations[frames])
        variance = np.column_stack([body.rotation_variance, body.root_variance])
        repair.variance[frames] = np.where(mask, variance, repair.variance[frames])
        repair.method[frames][mask] = RepairMethod.GAP_INTERPOLATED
    remaining &= ~is_body_lost[:, None]
    for n in np.flatnonzero(remaining.any(0) & ~is_lost.all(0)).tolist():
        for first, last in find_runs(remaining[:, n]):
            _interpolate_gap(repair, n, ~is_lost[:, n], FrameSpan(first, last, rate))


def _interpolate_gap(repair: AnimationRepair, n: int, is_sound: Bool[np.ndarray, " T"], span: FrameSpan) -> None:
    """Interpolate track n across a span, in place."""
    track = repair.get_track(n)

    def estimate(at: FrameSpan) -> list[SpanEstimate]:
        return _interpolate_tracks(track, methods.exclude_span(is_sound, at)[:, None], at)

    _store(repair, choose_estimate(estimate, track, np.array([-1]), is_sound, span), [n], span)


def _combine_body(body: methods.InterpolatedBody, context: GapContext, conditioner: PriorConditioner) -> methods.InterpolatedBody:
    """Return an interpolated body combined with the motion prior's prediction."""
    cropped = context.crop()
    local_rotations, joints = cropped.local_rotations.copy(), np.arange(body.local_rotations.shape[1])
    local_rotations[cropped.frames] = body.local_rotations
    prediction = conditioner.predict_gap(cropped._replace(local_rotations=local_rotations), joints)
    if prediction is None:
        return body
    rotations, rotation_variance = combine_rotations(body.local_rotations, body.rotation_variance, prediction)
    weight = compute_prediction_weight(body.root_variance, prediction.root_variance)
    root = body.root_position + weight[:, None] * (prediction.root_position - body.root_position)
    root_variance = compute_combined_variance(body.root_variance, prediction.root_variance, weight)
    return methods.InterpolatedBody(root, rotations, root_variance, rotation_variance)


UNAPPLIED_CHANGE_REASON = "its change was not applied"  # not among the kinds to repair, or rejected by a reviewer


@dataclass(frozen=True)
class RepairedAnimation:
    """A cleaned animation, and its changes."""

    animation: Animation  # cleaned
    # tips_before, tips_after: takes of the joint tips of the input and of the cleaned animation, without values that are lost
    tips_before: Take
    tips_after: Take
    joint_take: Take  # joint positions of the cleaned animation, with standard deviations
    faults: Faults
    changes: tuple[Change, ...]
    unfilled: tuple[UnfilledRun, ...]


def apply_repairs(
    animation: Animation,
    repair: AnimationRepair,
    faults: Sequence[Fault],
    options: CleanOptions,
    reviewed: Sequence[ReviewedChange],
) -> RepairedAnimation:
    """Apply repairs of faults to an animation and leave all other values unchanged.

    Decides by the options of detection (the kinds to repair) and of filling, and by the reviewed changes of an earlier cleaning.
    """
    tips = build_tip_take(animation)
    is_absent = build_fault_mask([fault for fault in faults if fault.kind == "gap"], tips.visible.shape)
    before = tips.masked(~is_absent)
    is_rejected = [any(each.rejects(fault) for each in reviewed) for fault in faults]
    kinds = options.detect.repair_kinds or {fault.kind for fault in faults}
    selected = [fault for fault, rejected in zip(faults, is_rejected, strict=True) if fault.kind in kinds and not rejected]
    editable = compute_editable_mask(before, options.fill)
    editable[:, -1] &= editable[:, animation.moving_joint]  # to keep the joint that moves the figure also keeps its position
    editable &= build_fault_mask(selected, is_absent.shape) & (repair.method != RepairMethod.UNCHANGED)
    rejection_reasons = _find_rejection_reasons(animation, before, repair, faults, editable, options.fill)
    is_repaired = editable & (rejection_reasons == "")
    repaired = insert_repairs(animation, repair, is_repaired)
    variance = np.where(is_repaired, repair.variance, 0.0)
    after = build_tip_take(repaired)
    after = _add_sd(repaired, after, variance, is_repaired | ~before.visible).masked(is_repaired | ~is_absent)
    joint_take = build_joint_take(repaired)
    joint_take = _add_sd(repaired, joint_take, variance, np.ones(joint_take.visible.shape, bool))
    # a change covers the joints of its fault and not those below them
    own_points = before.replace_markers(np.where(is_repaired[..., None], after.markers, before.markers), after.sample_sd)
    repaired_faults = [fault for fault in selected if is_repaired[fault.frame_slice][:, list(fault.markers)].any()]
    methods = np.where(is_repaired, np.array([REPAIR_DESCRIPTIONS[method] for method in RepairMethod], object)[repair.method], "")
    applied = [each for each, _ in changes.build_changes(before, before, own_points, repaired_faults, None, methods)]
    reasons = np.where(rejection_reasons == "", UNAPPLIED_CHANGE_REASON, rejection_reasons)
    unfilled = find_unfilled_runs(after.masked(rejection_reasons == ""), reasons)  # also held values that stay
    return RepairedAnimation(
        repaired, before, after, joint_take, Faults(tuple(faults)), (*applied, *(each.to_change() for each in reviewed)), unfilled
    )


def insert_repairs(animation: Animation, repair: AnimationRepair, is_repaired: Bool[np.ndarray, "T N"]) -> Animation:
    """Return the animation with the repaired values of the N = J + 1 tracks where `is_repaired`."""
    for joint in np.flatnonzero(is_repaired[:, :-1].any(0)):
        frames = np.flatnonzero(is_repaired[:, joint])
        animation = animation.replace_rotations(np.array([joint]), frames, repair.local_rotations[frames, joint][:, None])
    frames = np.flatnonzero(is_repaired[:, -1])
    if not len(frames):
        return animation
    return animation.replace_positions(np.array([animation.moving_joint]), frames, repair.root_position[frames][:, None])


def _find_rejection_reasons(
    animation: Animation,
    before: Take,
    repair: AnimationRepair,
    faults: Sequence[Fault],
    editable: Bool[np.ndarray, "T N"],
    fill_options: FillOptions,
) -> Shaped[np.ndarray, "T N"]:
    """Return why lost values are not filled, "" elsewhere. If one value of a gap is rejected, the whole gap is."""
    lost_faults = [fault for fault in faults if fault.kind in LOST_KINDS]
    is_lost = build_fault_mask(lost_faults, editable.shape)
    fully_repaired = insert_repairs(animation, repair, repair.method != RepairMethod.UNCHANGED)
    sd = compute_joint_point_sd(fully_repaired, build_tip_take(fully_repaired), repair.variance)
    sd = np.where(repair.method == RepairMethod.UNCHANGED, np.nan, sd)
    reasons = explain_unfilled_samples(before, is_lost & editable, compute_gap_durations(~is_lost, before.rate), sd, fill_options)
    for fault in lost_faults:
        if found := [reason for reason in reasons[fault.frame_slice][:, list(fault.markers)].ravel() if reason]:
            reasons[fault.frame_slice, list(fault.markers)] = found[0]
    return reasons


def _add_sd(
    animation: Animation, points: Take, variance: Float[np.ndarray, "T N"], is_estimated: Bool[np.ndarray, "T M"]
) -> Take:
    """Return the take of joints or tips with the standard deviations of the estimated points (variances of N tracks)."""
    sd = compute_joint_point_sd(animation, points, variance)
    return replace(points, sample_sd=np.where(is_estimated & (sd > 0), sd, np.nan))

"""Mislabelled markers: labels exchanged over the whole take, detected from the marker set's positions on a body.

The trajectories are smooth and keep their distances, so they do not show the exchange. A body is therefore fitted to some
frames, with the labels as they are and with an exchange undone. The difference between the two fits is the evidence. A marker
is attached once, so all frames of a take are one observation of its position, and one typical frame is as informative as all
of them.

The body is a known subject's, or the average one. Of the average body only the size is estimated from the take, so that a label
that is wrong throughout cannot shift the expected position of its marker.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import format_name_list, join_words
from mocapfix.labels.label_swaps import find_permutation_cycles
from mocapfix.model.faults import Fault
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import is_below, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.terms import compute_robust_costs
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.average_body import (
    PosedBody,
    build_average_subject,
    build_posed_body,
    compute_rest_marker_positions,
    estimate_body_size_ratio,
)
from mocapfix.subject.library import MIRROR_X

BODY_MARKER_SD_M = 0.030  # per axis: placement, the subject's proportions and skin motion together
ROBUST_SCALES_M = (0.4, 0.2, 0.1)  # scales of the robust loss (Geman & McClure 1987), from coarse to fine
MAX_BODY_FIT_ITERATIONS = 8  # number of iterations at each scale


def fit_markers(body: PosedBody, markers: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N K 3"]:
    """Return where the body, fitted to each frame by itself, has all its markers, in metres; `markers` are NaN where missing."""
    return body.predict(body.fit(markers, BODY_MARKER_SD_M, ROBUST_SCALES_M, MAX_BODY_FIT_ITERATIONS))


def compute_marker_misfit(markers: Float[np.ndarray, "... 3"], predicted: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Compute half the robust squared distance in standard deviations (Geman & McClure 1987), 0 where missing."""
    square = ((markers - predicted) ** 2).sum(-1)
    return np.nan_to_num(compute_robust_costs(square, ROBUST_SCALES_M[-1] ** 2)) / BODY_MARKER_SD_M**2


# Distance of a marker from the mirrored place of another within which the two mirror each other.
MAX_TWIN_DISTANCE_M = 0.15
MAX_BODY_FIT_FRAMES = 16  # number of frames to which the body is fitted, evenly spread over the fullest ones
MIN_RELATIVE_MARKER_COUNT = 0.9  # number of visible markers in these frames, relative to the fullest frame
MIN_FITTED_MARKERS = 12  # no body is fitted to frames with fewer markers
MIN_MARKER_FRAMES = 5  # number of the frames in which a marker must be visible
MAX_TESTED_PAIRS = 16  # number of pairs of markers for whose exchange the body is fitted again
MIN_PRELIMINARY_GAIN = -2.0  # in log likelihood, with the body unchanged; a true exchange loses nothing
MIN_EXCHANGE_GAIN = 0.5  # smallest gain in log likelihood of an exchange
CORRECT_LABEL_LOG_ODDS = 1.6  # of the prior that the labels are correct; a gain of 2 is just sufficient to change them
MAX_EXCHANGE_COUNT = 12  # number of exchanges in a take
MAX_MEAN_MISFIT = 2.0  # in log likelihood; with more these are not the set's markers, whatever their labels
MAX_REMAINING_MISPLACEMENT = 0.7  # from the body after an exchange is undone, relative to that before


@dataclass(frozen=True)
class RelabelStep:
    """One exchange that was undone."""

    permutation: np.ndarray  # for each of K markers (K,), the index of the marker whose label it has
    gain: float  # gain in log likelihood

    @property
    def is_exchanged(self) -> Bool[np.ndarray, " K"]:
        """Whether each marker has another one's label."""
        return self.permutation != np.arange(len(self.permutation))


def detect_mislabelled(take: Take, marker_set: MarkerSet, subject: Subject | None = None) -> list[Fault]:
    """Detect the cycles of labels that are exchanged over the whole take.

    If a limb or the whole body is mirrored, each pair of mirrored markers is a fault; all of them have the same reason. An
    exchange that occurs equally on both sides is not a fault but a naming convention of the studio.

    Args:
        subject: The subject, if known; otherwise the average body is used.

    Returns:
        The faults. Undone together, they leave every marker with its own label. Their severity is the median distance in
        metres of the exchanged markers from the body.
    """
    columns = marker_set.find_columns(take.labels)
    markers = select_fullest_frames(take.select(columns, take.visible).markers)
    if len(markers) == 0:
        return []
    if subject is None:
        size = estimate_body_size_ratio(marker_set, markers, min_frames=1)
        subject = build_average_subject(marker_set, size)
    body = build_posed_body(subject)
    own, is_in_take = np.arange(len(columns)), columns >= 0  # a marker that is not in the take has no label to exchange
    permutations = [np.where(is_in_take & is_in_take[each], each, own) for each in list_mirror_exchanges(marker_set)]
    order, steps = find_correct_labels(markers, body, permutations)
    if not steps:
        return []
    relabelled = np.ascontiguousarray(markers[:, order])
    predicted_before, predicted_after = fit_markers(body, markers), fit_markers(body, relabelled)
    misfit = compute_marker_misfit(relabelled, predicted_after)
    if misfit.sum() > MAX_MEAN_MISFIT * (~np.isnan(relabelled[..., 0])).sum():
        return []
    before_m, after_m = (np.linalg.norm(a - b, axis=-1) for a, b in ((markers, predicted_before), (relabelled, predicted_after)))
    cycles = select_one_sided_cycles(find_permutation_cycles(order), find_twins(marker_set))
    faults = [_build_mislabelled_fault(take, columns, order, cycle, steps, (before_m, after_m)) for cycle in cycles]
    return [fault for fault in faults if fault is not None]


def select_fullest_frames(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "N K 3"]:
    """Select up to MAX_BODY_FIT_FRAMES of the frames with the most visible markers, evenly over the take."""
    count = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(count >= max(MIN_FITTED_MARKERS, MIN_RELATIVE_MARKER_COUNT * count.max(initial=0)))
    return np.ascontiguousarray(markers[full[sample_evenly(len(full), MAX_BODY_FIT_FRAMES)]])


def find_correct_labels(
    markers: Float[np.ndarray, "N K 3"], body: PosedBody, permutations: list[Int[np.ndarray, " K"]]
) -> tuple[Int[np.ndarray, " K"], list[RelabelStep]]:
    """Search the correct labels by undoing one exchange after the other, each time the one with the largest gain.

    Args:
        permutations: Exchanges that are tried in addition to those of two markers.

    Returns:
        The index of the label that each marker has, and the steps.
    """
    order, steps = np.arange(markers.shape[1]), list[RelabelStep]()
    is_testable = (~np.isnan(markers[..., 0])).sum(0) >= MIN_MARKER_FRAMES
    while len(steps) < MAX_EXCHANGE_COUNT:
        current = np.ascontiguousarray(markers[:, order])
        predicted = fit_markers(body, current)
        misfit = compute_marker_misfit(current, predicted).sum(1)
        candidates = [*permutations, *find_pair_exchanges(current, predicted, is_testable[order])]
        if not candidates:
            break
        permuted = np.ascontiguousarray(current[:, candidates].swapaxes(0, 1))
        predicted = fit_markers(body, permuted.reshape(-1, *current.shape[1:])).reshape(permuted.shape)
        tried: list[RelabelStep] = []
        for permutation, gain in zip(candidates, misfit - compute_marker_misfit(permuted, predicted).sum(-1), strict=True):
            is_visible = ~np.isnan(current[:, permutation != np.arange(len(permutation)), 0]).all(1)
            is_known = is_visible.sum() >= MIN_MARKER_FRAMES
            tried.append(RelabelStep(permutation, float(np.median(gain[is_visible])) if is_known else 0.0))
        best = max(tried, key=lambda step: step.gain)
        if best.gain < MIN_EXCHANGE_GAIN:
            break
        order = order[best.permutation]
        steps.append(best)
    return order, steps


def find_pair_exchanges(
    markers: Float[np.ndarray, "N K 3"], predicted: Float[np.ndarray, "N K 3"], is_testable: Bool[np.ndarray, " K"]
) -> list[Int[np.ndarray, " K"]]:
    """Find the exchanges of two markers that may fit better, judged with the body unchanged, the most promising first."""
    visible_count = np.maximum((~np.isnan(markers[..., 0])).sum(0), 1)
    # mean misfit of the samples (columns) as the markers (rows)
    misfit = compute_marker_misfit(markers[:, None], predicted[:, :, None]).sum(0) / visible_count
    gain = np.diag(misfit)[:, None] + np.diag(misfit) - misfit - misfit.T
    first, second = np.triu_indices(len(is_testable), 1)
    gain = np.where(is_testable[first] & is_testable[second], gain[first, second], -np.inf)
    promising = np.argsort(-gain, kind="stable")[:MAX_TESTED_PAIRS]
    exchanges = np.tile(np.arange(len(is_testable)), ((gain[promising] > MIN_PRELIMINARY_GAIN).sum(), 1))
    for exchange, pair in zip(exchanges, promising, strict=False):
        exchange[[first[pair], second[pair]]] = second[pair], first[pair]
    return list(exchanges)


def find_twins(marker_set: MarkerSet) -> Int[np.ndarray, " K"]:
    """Find the index of the marker that mirrors each one; its own index if there is none or it lies in the middle."""
    rest = compute_rest_marker_positions(marker_set)
    distance_m = np.linalg.norm(rest[:, None] * MIRROR_X - rest[None], axis=-1)
    nearest, own = distance_m.argmin(1), np.arange(len(rest))
    return np.where((nearest[nearest] == own) & (distance_m.min(1) <= MAX_TWIN_DISTANCE_M), nearest, own)


def list_mirror_exchanges(marker_set: MarkerSet) -> list[Int[np.ndarray, " K"]]:
    """List the exchanges of left and right of each segment, and of each segment with its descendants (limb, whole body)."""
    parents, own, twin = load_cmu31_body().skeleton.parents, np.arange(len(marker_set.joints)), find_twins(marker_set)
    exchanges: dict[tuple[int, ...], np.ndarray] = {}
    for joint in range(len(parents)):
        is_own = marker_set.joints == joint
        for is_on_part in (is_own, is_own | [is_below(each, joint, parents) for each in marker_set.joints.tolist()]):
            exchange = np.where(is_on_part | is_on_part[twin], twin, own)
            if (exchange != own).sum() > 2:  # a single pair is among the exchanges of two markers
                exchanges[tuple(exchange.tolist())] = exchange
    return list(exchanges.values())


def select_one_sided_cycles(cycles: list[tuple[int, ...]], twin: Int[np.ndarray, " K"]) -> list[tuple[int, ...]]:
    """Remove the cycles that the mirrored markers form as well: those are a naming convention, not a mistake."""
    members = [set(cycle) for cycle in cycles]
    return [cycle for cycle in cycles if (mirrored := set(twin[list(cycle)].tolist())) == set(cycle) or mirrored not in members]


def _build_mislabelled_fault(
    take: Take,
    columns: np.ndarray,
    order: np.ndarray,
    cycle: tuple[int, ...],
    steps: list[RelabelStep],
    misplacement: tuple[np.ndarray, np.ndarray],
) -> Fault | None:
    """Build the fault of a cycle; None if undoing it brings the markers no nearer to the body.

    Args:
        misplacement: Distances (N, K) in metres of the markers from the body, before and after the exchanges are undone.
    """
    own_steps = [step for step in steps if step.is_exchanged[list(cycle)].any()]
    gain = sum(step.gain for step in own_steps)
    exchanged = np.flatnonzero(np.any([step.is_exchanged for step in own_steps], axis=0))
    before_m, after_m = (float(np.nanmedian(each[:, exchanged])) for each in misplacement)
    if after_m > MAX_REMAINING_MISPLACEMENT * before_m:
        return None
    where = f"their samples lie {before_m * 1e3:.0f} mm from the marker set's positions on the body"
    where += f", and {after_m * 1e3:.0f} mm after the exchange is undone."
    labels = [take.bare_labels[columns[k]] for k in cycle]
    if len(cycle) == 2 < len(exchanged):
        names = format_name_list([take.bare_labels[columns[k]] for k in exchanged if k < order[k]])
        reason = f"Left and right are exchanged over the whole take ({names}): {where}"
    elif len(cycle) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels over the whole take: {where}"
    else:
        reason = f"{join_words(labels)} have exchanged their labels in a cycle over the whole take: {where}"
    marker, *others = (int(columns[k]) for k in cycle)
    confidence = float(1 / (1 + np.exp(CORRECT_LABEL_LOG_ODDS - gain)))
    return Fault("mislabelled", marker, 0, take.frame_count - 1, before_m, reason, confidence, tuple(others))

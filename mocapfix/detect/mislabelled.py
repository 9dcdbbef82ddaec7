"""Left and right of a marker set: which marker is which one's twin, and which twins would be exchanged together."""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect import body_fitter
from mocapfix.detect.body_fitter import BodyFitter, compute_marker_misfit
from mocapfix.faults import Fault
from mocapfix.marker_sets import MarkerSet
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject
from mocapfix.take import Take

# MERGED: mocapfix.detect.sides
MIRROR_SIGNS = np.array([-1.0, 1.0, 1.0])  # the body rests facing +Z, so left and right differ in x


def find_twins(marker_set: MarkerSet) -> np.ndarray:
    """-> (K,) the index of each marker's twin on the other side; its own where it has none or is in the middle."""
    rest = body_fitter.compute_rest_markers(marker_set)
    nearest = np.linalg.norm(rest[:, None] * MIRROR_SIGNS - rest[None], axis=-1).argmin(1)
    own = np.arange(len(rest))
    return np.where(nearest[nearest] == own, nearest, own)


def list_mirror_exchanges(marker_set: MarkerSet) -> list[np.ndarray]:
    """-> the exchanges (K,) of left and right of each segment, and of each with all that hangs on it: a limb, the whole body."""
    parents, own, twin = load_cmu31_body().skeleton.parents, np.arange(len(marker_set.joints)), find_twins(marker_set)
    found = {}
    for joint in range(len(parents)):
        hanging = np.zeros(len(parents), bool)
        hanging[joint] = True
        for below in range(joint + 1, len(parents)):
            hanging[below] = hanging[parents[below]]
        for together in (marker_set.joints == joint, hanging[marker_set.joints]):
            touched = together | together[twin]
            exchange = np.where(touched, twin, own)
            if (exchange != own).sum() > 2:  # of two alone they are a pair like any other
                found[tuple(exchange)] = exchange
    return list(found.values())


def select_one_sided_cycles(cycles: list[tuple[int, ...]], twin: np.ndarray) -> list[tuple[int, ...]]:
    """-> the rings of markers but for those that the other side's twins (K,) make as well: a habit, not a mistake."""
    there = [set(ring) for ring in cycles]
    return [ring for ring in cycles if (other := set(twin[list(ring)].tolist())) == set(ring) or other not in there]


# MERGED: mocapfix.detect.mislabelled
# Mislabelled: labels exchanged over the whole take, told by where the marker set has them on a body.
#
# The trajectories are as smooth as ever and keep their distances, so nothing in the take itself tells. A body does, laid on some
# of its frames once with the labels as they are and once with an exchange undone: both fit worse than the true subject would,
# and what they differ by is the evidence. A marker is stuck on once, so all frames of a take are one observation of where, and a
# frame of the usual sort says as much as all of them.
MAX_BODY_FIT_FRAMES = 16  # frames, evenly over those that show most
MIN_RELATIVE_MARKER_COUNT = 0.9  # of the markers that the fullest frames show
MIN_FITTED_MARKERS = 12  # markers in them, with fewer of which no body is laid
MIN_MARKER_FRAMES = 5  # of the frames must show a marker
MAX_TESTED_PAIRS = 16  # of markers, at most, for whose exchange the body is laid anew
MIN_PRELIMINARY_GAIN = (
    -2.0
)  # log likelihood that such an exchange gains at least while the body stays as it lies: a true one costs nothing
MIN_EXCHANGE_GAIN = 0.5  # log likelihood: an exchange that gains less is none
CORRECT_LABEL_LOG_ODDS = 1.6  # log of the odds that labels are right, when a gain of 2 is just believed
MAX_EXCHANGE_COUNT = 12  # exchanges in a take
MAX_MEAN_MISFIT = (
    2.0  # log likelihood that each marker may miss on average: else these are not the set's markers, whatever their names
)


@dataclass(frozen=True)
class RelabelStep:
    """One exchange that was undone: of each of K markers, the one under whose label it was then; what it gained."""

    permutation: np.ndarray
    gain: float

    @property
    def is_exchanged(self) -> np.ndarray:
        return self.permutation != np.arange(len(self.permutation))


def detect_mislabelled(take: Take, marker_set: MarkerSet, subject: Subject | None = None) -> list[Fault]:
    """-> the rings of labels that are exchanged all along; undone together they leave every marker under its own.

    Of a mirrored limb, or a mirrored body, each pair of twins is a fault with one sentence in common. What is exchanged in the
    same way on both sides is no fault: so the studio names its markers.

    subject  who wears the set, where that is known from before; else the average body stands for everybody
    """
    columns = marker_set.find_columns(take.labels)
    markers = select_fullest_frames(take.select(columns, take.visible).markers)
    if len(markers) == 0:
        return []
    body = body_fitter.build_body_fitter(subject) if subject else body_fitter.build_average_body_fitter(marker_set, markers)
    own, there = np.arange(len(columns)), columns >= 0  # what is not in the take has no label to exchange
    groups = [np.where(there & there[each], each, own) for each in list_mirror_exchanges(marker_set)]
    order, steps = find_correct_labels(markers, body, groups)
    if not steps:
        return []
    right = np.ascontiguousarray(markers[:, order])
    as_is, placed = body.predict_markers(markers), body.predict_markers(right)
    if compute_marker_misfit(right, placed).sum() > MAX_MEAN_MISFIT * (~np.isnan(right[..., 0])).sum():
        return []
    was, is_now = (np.linalg.norm(one - other, axis=-1) for one, other in ((markers, as_is), (right, placed)))
    wrong = select_one_sided_cycles(find_permutation_cycles(order), find_twins(marker_set))
    return [_build_mislabelled_fault(take, columns, order, ring, steps, was, is_now) for ring in wrong]


def select_fullest_frames(markers: np.ndarray) -> np.ndarray:
    """-> (N, K, 3) up to LOOKS of the frames of markers (T, K, 3) that show the most, evenly over the take."""
    count = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(count >= max(MIN_FITTED_MARKERS, MIN_RELATIVE_MARKER_COUNT * count.max(initial=0)))
    some = np.unique(np.linspace(0, len(full) - 1, MAX_BODY_FIT_FRAMES).astype(int)) if len(full) else full
    return np.ascontiguousarray(markers[full[some]])


def find_correct_labels(
    markers: np.ndarray, fitter: BodyFitter, permutations: list[np.ndarray]
) -> tuple[np.ndarray, list[RelabelStep]]:
    """-> (K,) the label that each marker is under, and the steps to it, each the one that gained most of all tried."""
    order, steps = np.arange(markers.shape[1]), []
    seen = (~np.isnan(markers[..., 0])).sum(0) >= MIN_MARKER_FRAMES
    while len(steps) < MAX_EXCHANGE_COUNT:
        now = np.ascontiguousarray(markers[:, order])
        placed = fitter.predict_markers(now)
        as_is = compute_marker_misfit(now, placed).sum(1)
        tried = [
            _evaluate_permutation(now, fitter, as_is, exchange)
            for exchange in [*permutations, *find_pair_exchanges(now, placed, seen[order])]
        ]
        best = max(tried, key=lambda step: step.gain)
        if best.gain < MIN_EXCHANGE_GAIN:
            break
        order = order[best.permutation]
        steps.append(best)
    return order, steps


def _evaluate_permutation(
    markers: np.ndarray, fitter: BodyFitter, current_misfit: np.ndarray, permutation: np.ndarray
) -> RelabelStep:
    other = np.ascontiguousarray(markers[:, permutation])
    touched = permutation != np.arange(len(permutation))
    shown = ~np.isnan(markers[:, touched, 0]).all(1)
    gain = current_misfit - compute_marker_misfit(other, fitter.predict_markers(other)).sum(1)
    return RelabelStep(permutation, float(np.median(gain[shown])) if shown.sum() >= MIN_MARKER_FRAMES else 0.0)


def find_pair_exchanges(markers: np.ndarray, predicted: np.ndarray, is_testable: np.ndarray) -> list[np.ndarray]:
    """-> the exchanges of two that might fit better: by what they do while the body stays as it lies, the likeliest first."""
    often = np.maximum((~np.isnan(markers[..., 0])).sum(0), 1)
    fit = (
        compute_marker_misfit(markers[:, None], predicted[:, :, None]).sum(0) / often
    )  # of samples (columns) as the markers (rows)
    gain = np.diag(fit)[:, None] + np.diag(fit) - fit - fit.T
    first, second = np.triu_indices(len(is_testable), 1)
    gain = np.where(is_testable[first] & is_testable[second], gain[first, second], -np.inf)
    likely = np.argsort(-gain, kind="stable")[:MAX_TESTED_PAIRS]
    exchanges = np.tile(np.arange(len(is_testable)), ((gain[likely] > MIN_PRELIMINARY_GAIN).sum(), 1))
    for exchange, pair in zip(exchanges, likely, strict=False):
        exchange[[first[pair], second[pair]]] = second[pair], first[pair]
    return list(exchanges)


def find_permutation_cycles(order: np.ndarray) -> list[tuple[int, ...]]:
    """-> the rings of a permutation but those of one: each is followed by the one under whose label it is."""
    found, left = [], set(range(len(order)))
    while left:
        ring = [min(left)]
        while (following := int(order[ring[-1]])) != ring[0]:
            ring.append(following)
        left -= set(ring)
        found += [tuple(ring)] if len(ring) > 1 else []
    return found


def _build_mislabelled_fault(
    take: Take,
    columns: np.ndarray,
    order: np.ndarray,
    cycle: tuple[int, ...],
    steps: list[RelabelStep],
    distance_before_m: np.ndarray,
    distance_after_m: np.ndarray,
) -> Fault:
    """-> what is said of one ring; was, is_now (N, K) metres: how far from the body the markers lie before and after `steps`."""
    own = [step for step in steps if step.is_exchanged[list(cycle)].any()]
    gain = sum(step.gain for step in own)
    touched = np.flatnonzero(np.any([step.is_exchanged for step in own], axis=0))
    before, after = (float(np.nanmedian(each[:, touched])) for each in (distance_before_m, distance_after_m))
    off = f"their samples lie {before * 1e3:.0f} mm from where the marker set has them on a body"
    off += f", the other way round {after * 1e3:.0f} mm."
    labels = [take.bare_labels[columns[k]] for k in cycle]
    if len(cycle) == 2 < len(touched):
        names = ", ".join(take.bare_labels[columns[k]] for k in touched if k < order[k])
        reason = f"Left and right are exchanged over the whole take: {names} are the other side's, and {off}"
    elif len(cycle) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels over the whole take: {off}"
    else:
        reason = f"{', '.join(labels)} and again {labels[0]} each follow the one before over the whole take: {off}"
    marker, *others = (int(columns[k]) for k in cycle)
    return Fault(
        "mislabelled",
        marker,
        0,
        take.frame_count - 1,
        before,
        reason,
        float(1 / (1 + np.exp(CORRECT_LABEL_LOG_ODDS - gain))),
        tuple(others),
    )

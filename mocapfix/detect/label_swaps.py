"""Label swaps: two labels, or three in a cycle, that follow one another's markers for a while.

Where labels are exchanged, each trajectory leaps to where another one was going. In between, the distances to each marker's
segment are broken, and they hold again after the exchange ends. Often the exchange happens in a gap and no leap is visible, or
the take ends before the exchange does. Then the distances decide which part is wrong; without them the shorter part is assumed
to be wrong. A swap without such evidence has a low confidence, and its labels are left unchanged.

Swaps are searched among few candidates. Marker i may have label j's samples if j leaps or appears where i would have
continued while i leaps or disappears, or if i's own samples contradict i's distances for some time and those of j match
them.
"""

import numpy as np

from mocapfix.detect.continuity import MarkerTrajectories, build_trajectories
from mocapfix.detect.marker_distances import MarkerDistances, estimate_distances
from mocapfix.detect.swap_viterbi import LabelExchange, find_exchanges
from mocapfix.faults import MIN_LABEL_CONFIDENCE, Fault, overlap_in_time
from mocapfix.kernels.label_evidence import (
    MIN_SWAP_CONTRADICTION,
    compute_mean_contradictions,
    compute_own_contradictions,
    compute_own_leaps,
    mark_continuations,
)
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

# Number of passes over the take: a corrected swap lets the next pass estimate the distances better.
MAX_SWAP_PASSES = 5
# Smallest cost, in leaps, that an exchange saves.
MIN_SWAP_GAIN = 0.7

# Largest contradiction of the other marker's distances, relative to that of the own ones.
MAX_RELATIVE_CONTRADICTION = 0.85
# Shortest stretch of contradictions that makes a candidate.
MIN_CONTRADICTION_DURATION_S = 0.05
# A label that is visible in a smaller fraction of the take is a fragment, not a marker.
MIN_LABEL_VISIBLE_FRACTION = 0.5
# Number of frames of a stretch at which other labels are compared.
MAX_COMPARED_FRAMES = 9


def detect_label_swaps(take: Take) -> list[Fault]:
    """Detect the swaps of a take.

    Returns:
        The faults, in the order in which they have to be undone. Their severity is the median distance in metres between the
        exchanged samples.
    """
    swaps: list[Fault] = []
    for _ in range(MAX_SWAP_PASSES):
        found = [_build_swap_fault(take, exchange) for exchange in _select_exchanges(take)]
        found = [swap for swap in found if not any(swap.overlaps(old) for old in swaps)]
        swaps += found
        for swap in found:
            if swap.confidence >= MIN_LABEL_CONFIDENCE:
                take = take.exchange_labels(swap.markers, swap.first, swap.last)
        if not any(swap.confidence >= MIN_LABEL_CONFIDENCE for swap in found):
            break
    return swaps


def _select_exchanges(take: Take) -> list[LabelExchange]:
    """Select the exchanges with the largest gain, ordered by first frame.

    An exchange that overlaps with a better one is left to the next pass.
    """
    if take.frame_count < 2 or not len(take.labels):
        return []
    trajectories, distances = build_trajectories(take.markers, take.rate), estimate_distances(take.markers)
    candidates = [
        exchange
        for group in find_swap_candidates(trajectories, distances)
        for exchange in find_exchanges(group, trajectories, distances)
    ]
    selected: list[LabelExchange] = []
    for exchange in sorted(candidates, key=lambda exchange: -exchange.gain):
        if exchange.gain > MIN_SWAP_GAIN and not any(overlap_in_time(exchange, other) for other in selected):
            selected.append(exchange)
    return sorted(selected, key=lambda exchange: exchange.first)


def _build_swap_fault(take: Take, exchange: LabelExchange) -> Fault:
    cycle, first, last = exchange.cycle, exchange.first, exchange.last
    separation_m = _measure_separation(take.markers[first : last + 1], cycle)
    share = (last - first + 1) / (take.frame_count + 1)
    wrong_part_odds = share / (1 - share) * np.exp(-np.clip(exchange.counter_evidence, -50, 50))
    confidence = float((1 - np.exp(-exchange.gain)) / (1 + wrong_part_odds))
    labels = [take.bare_labels[m] for m in cycle]
    duration = f"{(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    distance = f"{separation_m * 1e3:.0f} mm" if np.isfinite(separation_m) else "away"
    names = f"{', '.join(labels[:-1])} and {labels[-1]}"
    exchange_text = "exchanged their labels" if len(cycle) == 2 else "exchanged their labels in a cycle"
    reason = f"{names} have {exchange_text} for {duration}: their samples lie {distance} from their markers."
    return Fault("swap", cycle[0], first, last, separation_m, reason, confidence, cycle[1:])


def _measure_separation(points: np.ndarray, cycle: tuple[int, ...]) -> float:
    """Measure the median distance in metres between the samples of successive labels, NaN if no two are visible together."""
    distance_m = np.linalg.norm(points[:, cycle] - points[:, np.roll(cycle, -1)], axis=-1)
    return float(np.nanmedian(distance_m)) if np.isfinite(distance_m).any() else float("nan")


def find_swap_candidates(trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[tuple[int, ...]]:
    """Find the pairs and triples of markers whose labels may have been exchanged."""
    count = trajectories.previous_frame.shape[1]
    is_candidate = np.zeros((count, count), bool)
    own = compute_own_contradictions(trajectories.markers, distances, 1.0)
    mark_continuations(trajectories, distances, compute_own_leaps(trajectories), own, is_candidate)
    _mark_distance_matches(trajectories, distances, own, is_candidate)
    is_rare = np.isnan(trajectories.markers[..., 0]).mean(0) > 1 - MIN_LABEL_VISIBLE_FRACTION
    is_candidate[is_rare] = is_candidate[:, is_rare] = False
    pairs: set[tuple[int, ...]] = {tuple(sorted(map(int, pair))) for pair in np.argwhere(is_candidate)}
    triples: set[tuple[int, ...]] = set()
    for i, j in np.argwhere(is_candidate):
        for k in np.flatnonzero(is_candidate[j]):
            if len({i, j, k}) == 3:
                triples.add(tuple(sorted((int(i), int(j), int(k)))))
    return sorted(pairs) + sorted(triples)


def _mark_distance_matches(
    trajectories: MarkerTrajectories, distances: MarkerDistances, own_contradiction: np.ndarray, is_candidate: np.ndarray
) -> None:
    """Mark in `is_candidate` (M, M) that label j's samples match the distances of marker i and contradict those of j."""
    visible = ~np.isnan(trajectories.markers[..., 0])
    for j in range(own_contradiction.shape[1]):
        for first, last in find_runs(visible[:, j] & (own_contradiction[:, j] > MIN_SWAP_CONTRADICTION)):
            if last - first + 1 < MIN_CONTRADICTION_DURATION_S * trajectories.rate:
                continue
            frames = np.unique(np.linspace(first, last, MAX_COMPARED_FRAMES).astype(int))
            misfit = compute_mean_contradictions(trajectories.markers, distances, frames, j)
            is_better = misfit < MAX_RELATIVE_CONTRADICTION * own_contradiction[frames, j].mean()
            is_candidate[:, j] |= is_better & (own_contradiction[frames].mean(0) > MIN_SWAP_CONTRADICTION)
            is_candidate[j, j] = False

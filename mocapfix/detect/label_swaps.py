"""Which markers may have exchanged their labels: a first look that costs little and lets nothing pass.

Two hints say that marker i may ride on label j: j leaps, or appears, where i would have gone on, and i leaps or
disappears; or for some time i's own samples contradict i's distances and those of j keep them.
"""

import numpy as np
from numba import njit

from mocapfix.detect import continuity, marker_distances
from mocapfix.detect.continuity import MarkerTrajectories, compute_leap, compute_own_leaps
from mocapfix.detect.marker_distances import MarkerDistances, compute_contradiction, compute_own_contradictions
from mocapfix.detect.swap_viterbi import LabelExchange, find_exchanges
from mocapfix.faults import MIN_LABEL_CONFIDENCE, Fault
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

# MERGED: mocapfix.detect.candidates
MIN_CANDIDATE_LEAP = 0.5  # of a leap: a label that does so may change its marker
MAX_CONTINUATION_LEAP = 0.3  # of a leap: where another goes on so well, it may be the same marker
MIN_SWAP_CONTRADICTION = 0.3  # how far samples contradict a marker's distances that may be another's
MAX_RELATIVE_CONTRADICTION = 0.85  # of that: how far they contradict the other's at most
MIN_CONTRADICTION_DURATION_S = 0.05  # seconds: for less than that distances hint at nothing
MAX_UNSEEN_DURATION_S = 0.1  # seconds since a marker was seen: later a label is too easily where it might have gone
MIN_LABEL_VISIBLE_FRACTION = 0.5  # of the take: a label seen in less of it is a fragment, not a marker of its own
MAX_COMPARED_FRAMES = 9  # frames of a stretch at which other labels are tried


def find_swap_candidates(trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[tuple[int, ...]]:
    """-> pairs and triples of markers among which labels may have been exchanged."""
    count = trajectories.previous_frame.shape[1]
    rides = np.zeros((count, count), bool)
    own = compute_own_contradictions(trajectories.markers, distances, 1.0)
    _mark_continuations(trajectories, distances, compute_own_leaps(trajectories), own, rides)
    _mark_distance_matches(trajectories, distances, own, rides)
    rare = np.isnan(trajectories.markers[..., 0]).mean(0) > 1 - MIN_LABEL_VISIBLE_FRACTION
    rides[rare] = rides[:, rare] = False
    pairs = {tuple(sorted(map(int, pair))) for pair in np.argwhere(rides)}
    triples = set()
    for i, j in np.argwhere(rides):
        for k in np.flatnonzero(rides[j]):
            if len({i, j, k}) == 3:
                triples.add(tuple(sorted((int(i), int(j), int(k)))))
    return sorted(pairs) + sorted(triples)


@njit(cache=True)
def _mark_continuations(trajectories, distances, leaps, own_contradiction, is_candidate):
    """Mark in `rides` (M, M) that marker i may go on under label j where one leaps to where the other was going.

    Unless the distances of marker i are against it.
    """
    frames, count = leaps.shape
    nobody = np.zeros(count, np.bool_)
    for t in range(1, frames):
        for j in range(count):
            appears = trajectories.previous_frame[t, j] != t - 1
            if np.isnan(trajectories.markers[t, j, 0]) or not (leaps[t, j] > MIN_CANDIDATE_LEAP or appears):
                continue
            for i in range(count):
                gone = np.isnan(trajectories.markers[t, i, 0])
                late = t - trajectories.previous_frame[t, i] > MAX_UNSEEN_DURATION_S * trajectories.rate
                if (
                    i == j
                    or is_candidate[i, j]
                    or not (gone or leaps[t, i] > MIN_CANDIDATE_LEAP)
                    or trajectories.previous_frame[t, i] < 0
                    or late
                ):
                    continue
                if compute_leap(trajectories, t, i, j) < MAX_CONTINUATION_LEAP:
                    off = compute_contradiction(trajectories.markers, distances, t, j, i, nobody, 1.0)
                    is_candidate[i, j] = off <= own_contradiction[t, j] + MIN_SWAP_CONTRADICTION


def _mark_distance_matches(
    trajectories: MarkerTrajectories, distances: MarkerDistances, own_contradiction: np.ndarray, is_candidate: np.ndarray
) -> None:
    """Mark in `rides` (M, M) that marker i may ride on label j where its samples keep i's distances and not j's."""
    seen = ~np.isnan(trajectories.markers[..., 0])
    for j in range(own_contradiction.shape[1]):
        for first, last in find_runs(seen[:, j] & (own_contradiction[:, j] > MIN_SWAP_CONTRADICTION)):
            if last - first + 1 < MIN_CONTRADICTION_DURATION_S * trajectories.rate:
                continue
            looks = np.unique(np.linspace(first, last, MAX_COMPARED_FRAMES).astype(int))
            fit = _compute_mean_contradictions(trajectories.markers, distances, looks, j)
            is_candidate[:, j] |= (fit < MAX_RELATIVE_CONTRADICTION * own_contradiction[looks, j].mean()) & (
                own_contradiction[looks].mean(0) > MIN_SWAP_CONTRADICTION
            )
            is_candidate[j, j] = False


@njit(cache=True)
def _compute_mean_contradictions(markers, distances, frames, label):
    """-> (M,) how badly the samples under a label contradict each marker's distances on average."""
    count = markers.shape[1]
    nobody, fit = np.zeros(count, np.bool_), np.zeros(count)
    for m in range(count):
        for t in frames:
            fit[m] += compute_contradiction(markers, distances, t, label, m, nobody, 1.0) / len(frames)
    return fit


# MERGED: mocapfix.detect.swaps
# Swaps: two labels, or three in a ring, that for a while follow one another's markers.
#
# Where labels are exchanged, each trajectory leaps to where another was going; in between, each marker's distances to its
# segment are broken and are whole again once the labels are put back. Often the exchange happens in a gap and there is no
# leap to see, or the take ends before the labels are put right. Whichever part then is wrong is told by the distances, and
# else the shorter is the likelier: what cannot be told is found with little confidence and is left as it is.
MAX_SWAP_PASSES = 5  # at the take: what one look puts right lets the next learn the distances better
MIN_SWAP_GAIN = 0.7  # leaps: an exchange that explains less is none


def detect_label_swaps(take: Take) -> list[Fault]:
    """-> the swaps of a take, in the order in which they are to be undone."""
    swaps: list[Fault] = []
    for _ in range(MAX_SWAP_PASSES):
        new = [_build_swap_fault(take, exchange) for exchange in _select_exchanges(take)]
        new = [swap for swap in new if not any(swap.overlaps(old) for old in swaps)]
        swaps += new
        for swap in new:
            if swap.confidence >= MIN_LABEL_CONFIDENCE:
                take = take.exchange_labels(swap.markers, swap.first, swap.last)
        if not any(swap.confidence >= MIN_LABEL_CONFIDENCE for swap in new):
            break
    return swaps


def _select_exchanges(take: Take) -> list[LabelExchange]:
    """-> the exchanges that explain most, by first frame; one that overlaps with a better one waits for the next look."""
    if take.frame_count < 2 or not len(take.labels):
        return []
    courses, known = continuity.build_trajectories(take.markers, take.rate), marker_distances.estimate_distances(take.markers)
    chosen: list[LabelExchange] = []
    possible = [exchange for group in find_swap_candidates(courses, known) for exchange in find_exchanges(group, courses, known)]
    for exchange in sorted(possible, key=lambda each: -each.gain):
        if exchange.gain > MIN_SWAP_GAIN and not any(_do_exchanges_overlap(exchange, other) for other in chosen):
            chosen.append(exchange)
    return sorted(chosen, key=lambda each: each.first)


def _do_exchanges_overlap(one: LabelExchange, other: LabelExchange) -> bool:
    return one.first <= other.last and other.first <= one.last


def _build_swap_fault(take: Take, exchange: LabelExchange) -> Fault:
    ring, (first, last) = exchange.cycle, (exchange.first, exchange.last)
    apart = _measure_separation(take.markers[first : last + 1], ring)
    share = (last - first + 1) / (take.frame_count + 1)
    wrong_side = share / (1 - share) * np.exp(-np.clip(exchange.counter_evidence, -50, 50))
    confidence = float((1 - np.exp(-exchange.gain)) / (1 + wrong_side))
    labels = [take.bare_labels[m] for m in ring]
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    far = f"{apart * 1e3:.0f} mm from where they belong" if np.isfinite(apart) else "somewhere else"
    if len(ring) == 2:
        reason = f"{labels[0]} and {labels[1]} have exchanged their labels {time}: their samples lie {far}."
    else:
        reason = f"{', '.join(labels)} and again {labels[0]} each follow the one before {time}: their samples lie {far}."
    return Fault("swap", ring[0], first, last, apart, reason, confidence, ring[1:])


def _measure_separation(points: np.ndarray, cycle: tuple[int, ...]) -> float:
    """-> metres between each label's sample and that of the label it should have, the median; NaN where never both are seen."""
    distance = np.linalg.norm(points[:, cycle] - points[:, np.roll(cycle, -1)], axis=-1)
    return float(np.nanmedian(distance)) if np.isfinite(distance).any() else float("nan")

"""Label swaps: two labels, or three in a cycle, that follow one another's markers for a while.

Where labels are exchanged, each trajectory leaps to where another one was going. In between, the distances to each marker's
segment are broken, and they hold again after the exchange ends. Often the exchange happens in a gap and no leap is visible, or
the take ends before the exchange does. Then the distances decide which part is wrong; without them the shorter part is assumed
to be wrong. A swap without such evidence has a low confidence, and its labels are left unchanged.

Swaps are searched among few candidates. Marker i may have label j's samples if j leaps or appears where i would have
continued while i leaps or disappears, or if i's own samples contradict i's distances for some time and those of j match
them.

In a small group of candidates, the markers that the labels follow are found frame by frame, as the cheapest sequence of
permutations. In each state, every marker of the group has the samples of one label of the group. A sequence of states pays for
each leap of its markers, for samples that contradict the distances of the markers that they are assigned to, and for each change
of state. The cheapest sequence is found exactly (Viterbi's algorithm). All costs are in leaps, where 1 is the largest leap that
counts, so neither a spike nor a momentary contradiction causes a change. Where labels change within a gap, without a visible
leap, the distances alone decide.
"""

from collections.abc import Iterable, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from mocapfix.errors import join_words
from mocapfix.kernels.label_evidence import (
    compute_exchange_costs,
    compute_own_contradictions,
    compute_own_leaps,
    mark_continuations,
    mark_distance_matches,
)
from mocapfix.kernels.viterbi import find_cheapest_chain
from mocapfix.model.faults import LABEL_KINDS, MIN_LABEL_CONFIDENCE, Fault, overlap_in_time
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import MarkerDistances, MarkerTrajectories, build_trajectories, estimate_distances
from mocapfix.stats.sequences import find_cheapest_states, find_runs

MIN_PARTIAL_SWAP_DURATION_S = 0.1  # shortest exchange with a label that is missing at that time: a shorter one may be a spike
MAX_SPIKE_DURATION_S = 0.05  # longest spike that may look like an exchange with a missing label
SWAPPED_COST_PER_S = 0.1  # cost, in leaps a second, of all exchanged states: without evidence, labels are assumed to be correct
MIN_SWAP_GAIN = 0.7  # smallest cost, in leaps, that an exchange saves
# Largest contradiction of exchanged samples, relative to that of the labels as they are, if no leap shows the exchange. In a rare
# pose of several seconds neither fits: 0.76 to 0.96 were measured there for the two markers of a wrist.
MAX_EXCHANGED_MISFIT = 0.6


class LabelExchange(NamedTuple):
    """An exchange of labels over the frames first..last."""

    cycle: tuple[int, ...]  # marker indices. The samples of each marker are under the next one's label.
    first: int  # index of the first frame
    last: int  # index of the last frame
    gain: float  # cost in leaps that undoing the exchange saves
    counter_evidence: float  # cost in leaps, by the distances, if these frames were correct and all others exchanged


def find_exchanges(group: tuple[int, ...], trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[LabelExchange]:
    """Find the exchanges of labels in a group of two or three markers, ordered by first frame."""
    states = np.array(list(permutations(range(len(group)))))  # marker i has the samples of label states[s, i]
    step_cost, state_cost = compute_exchange_costs(states, np.array(group), trajectories, distances)
    swapped_cost = SWAPPED_COST_PER_S / trajectories.rate * (np.arange(len(states)) > 0)
    state = find_cheapest_states(step_cost[1:], state_cost + swapped_cost)
    visible = ~np.isnan(trajectories.markers[:, group, 0])
    exchanges: list[LabelExchange] = []
    for s in range(1, len(states)):
        extra_cost = state_cost[:, s] - state_cost[:, 0]
        for first, last in find_runs(state == s):
            inside = slice(first, last + 1)
            unchanged = np.where((np.arange(len(state)) >= first) & (np.arange(len(state)) <= last), 0, state)
            t = np.arange(max(first, 1), min(last + 2, len(state)))
            leap_gain = float((step_cost[t, unchanged[t - 1], unchanged[t]] - step_cost[t, state[t - 1], state[t]]).sum())
            misfit_share = float(state_cost[inside, s].sum()) / max(float(state_cost[inside, 0].sum()), 1e-9)
            if leap_gain < MIN_SWAP_GAIN and misfit_share > MAX_EXCHANGED_MISFIT:
                continue
            gain = leap_gain - float(extra_cost[inside].sum())
            counter_evidence = float(extra_cost[state == 0].sum() - extra_cost[inside].sum())
            for cycle in find_permutation_cycles(states[s]):
                exchanged = first + np.flatnonzero(visible[inside][:, cycle].any(1))
                is_complete = visible[inside][:, cycle].any(0).all()
                if len(exchanged) >= (1 if is_complete else MIN_PARTIAL_SWAP_DURATION_S * trajectories.rate):
                    markers = tuple(group[i] for i in cycle)
                    exchanges.append(LabelExchange(markers, int(exchanged[0]), int(exchanged[-1]), gain, counter_evidence))
    return sorted(exchanges, key=lambda exchange: exchange.first)


def find_permutation_cycles(permutation: np.ndarray) -> list[tuple[int, ...]]:
    """Find the cycles of at least two elements of a permutation; each element i is followed by permutation[i]."""
    cycles: list[tuple[int, ...]] = []
    remaining = set(range(len(permutation)))
    while remaining:
        cycle = [min(remaining)]
        while (following := int(permutation[cycle[-1]])) != cycle[0]:
            cycle.append(following)
        remaining -= set(cycle)
        if len(cycle) > 1:
            cycles.append(tuple(cycle))
    return cycles


MAX_SWAP_PASSES = 5
MIN_LABEL_VISIBLE_FRACTION = 0.5  # a label that is visible in a smaller fraction of the take is a fragment, not a marker
MAX_SWAP_TRIPLES = 1000  # above which only pairs are compared: labels are then arbitrary, not exchanged here and there


def detect_label_swaps(take: Take) -> list[Fault]:
    """Detect the swaps of a take.

    Returns:
        The faults, in the order in which they have to be undone. Their severity is the median distance in metres between the
        exchanged samples.
    """
    swaps: list[Fault] = []
    for _ in range(MAX_SWAP_PASSES):
        found = [_build_swap_fault(take, exchange) for exchange in _reject_spikes(take, _select_exchanges(take))]
        found = [swap for swap in found if not any(swap.overlaps(old) for old in swaps)]
        swaps += found
        for swap in found:
            if swap.confidence >= MIN_LABEL_CONFIDENCE:
                take = take.exchange_labels(swap.markers, swap.first, swap.last)
        if not any(swap.confidence >= MIN_LABEL_CONFIDENCE for swap in found):
            break
    return swaps


def _select_exchanges(take: Take) -> list[LabelExchange]:
    """Select the exchanges with the largest gain by first frame; one that overlaps a better one is for the next pass."""
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


def _reject_spikes(take: Take, exchanges: list[LabelExchange]) -> list[LabelExchange]:
    """Return the exchanges without those with a missing label that are not found if the spikes of their labels are removed."""
    partial = {each for each in exchanges if not take.visible[each.first : each.last + 1, each.cycle].any(0).all()}
    markers, spike_frames = take.markers.copy(), max(1, round(MAX_SPIKE_DURATION_S * take.rate))
    for m in {m for each in partial for m in each.cycle}:
        frames = np.flatnonzero(take.visible[:, m])
        is_kept = find_cheapest_chain(frames, np.ascontiguousarray(markers[frames, m]), take.rate, spike_frames)
        markers[frames[~is_kept], m] = np.nan
    sound = [(set(each.cycle), each) for each in _select_exchanges(take.replace_markers(markers))] if partial else []
    confirmed = {each for each in partial if any(set(each.cycle) == of and overlap_in_time(each, other) for of, other in sound)}
    return [each for each in exchanges if each in confirmed or each not in partial]


def _build_swap_fault(take: Take, exchange: LabelExchange) -> Fault:
    share = (exchange.last - exchange.first + 1) / (take.frame_count + 1)
    wrong_part_odds = share / (1 - share) * np.exp(-np.clip(exchange.counter_evidence, -50, 50))
    confidence = float((1 - np.exp(-exchange.gain)) / (1 + wrong_part_odds))
    return build_exchange_fault(take, exchange.cycle, (exchange.first, exchange.last), confidence, take.bare_labels)


def build_exchange_fault(
    take: Take, cycle: tuple[int, ...], interval: tuple[int, int], confidence: float, labels: Sequence[str]
) -> Fault:
    """Build the fault of labels that are exchanged in a cycle of markers; `labels` are those of all markers in its reason."""
    first, last = interval
    points = take.markers[first : last + 1]
    distance_m = np.linalg.norm(points[:, cycle] - points[:, np.roll(cycle, -1)], axis=-1)
    separation_m = float(np.nanmedian(distance_m)) if np.isfinite(distance_m).any() else float("nan")
    duration = f"{(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    distance = f"{separation_m * 1e3:.0f} mm" if np.isfinite(separation_m) else "away"
    exchange_text = "exchanged their labels" if len(cycle) == 2 else "exchanged their labels in a cycle"
    names = join_words([labels[m] for m in cycle])
    reason = f"{names} have {exchange_text} for {duration}: their samples lie {distance} from their markers."
    return Fault("swap", cycle[0], first, last, separation_m, reason, confidence, cycle[1:])


def find_swap_candidates(trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[tuple[int, ...]]:
    """Find the pairs and triples of markers whose labels may have been exchanged; no triples if there are too many."""
    count = trajectories.previous_frame.shape[1]
    is_candidate = np.zeros((count, count), bool)
    own = compute_own_contradictions(trajectories.markers, distances, 1.0)
    mark_continuations(trajectories, distances, compute_own_leaps(trajectories), own, is_candidate)
    mark_distance_matches(trajectories, distances, own, is_candidate)
    is_rare = np.isnan(trajectories.markers[..., 0]).mean(0) > 1 - MIN_LABEL_VISIBLE_FRACTION
    is_candidate[is_rare] = is_candidate[:, is_rare] = False
    pairs: set[tuple[int, ...]] = {tuple(sorted(map(int, pair))) for pair in np.argwhere(is_candidate)}
    triples: set[tuple[int, ...]] = set()
    for i, j in np.argwhere(is_candidate):
        for k in np.flatnonzero(is_candidate[j]):
            if len({i, j, k}) == 3:
                triples.add(tuple(sorted((int(i), int(j), int(k)))))
    return sorted(pairs) + (sorted(triples) if len(triples) <= MAX_SWAP_TRIPLES else [])


def undo_label_exchanges(take: Take, faults: Iterable[Fault]) -> Take:
    """Undo the exchanges of labels with a sufficient confidence, in the given order. Other faults are ignored."""
    exchanges = [
        (fault.markers, fault.first, fault.last)
        for fault in faults
        if fault.kind in LABEL_KINDS and fault.confidence >= MIN_LABEL_CONFIDENCE
    ]
    return take.exchange_labels_in_turn(exchanges) if exchanges else take

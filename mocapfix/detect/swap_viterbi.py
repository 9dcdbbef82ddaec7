"""Which markers the labels of a small group follow, frame by frame: the cheapest sequence of permutations.

In each state, every marker of the group has the samples of one label of the group. A sequence of states pays for each leap
of its markers, for samples that contradict the distances of the markers that they are assigned to, and for each change of
state. The cheapest sequence is found exactly (Viterbi's algorithm). All costs are in leaps, where 1 is the largest leap that
counts, so neither a spike nor a momentary contradiction causes a change. Where labels change within a gap, without a visible
leap, the distances alone decide.
"""

from itertools import permutations
from typing import NamedTuple

import numpy as np

from mocapfix.detect.continuity import MarkerTrajectories
from mocapfix.detect.marker_distances import MarkerDistances
from mocapfix.kernels.label_evidence import compute_exchange_costs
from mocapfix.stats.sequences import find_cheapest_states, find_runs

# Shortest exchange with a label that is missing at that time: a shorter one may be a spike.
MIN_PARTIAL_SWAP_DURATION_S = 0.1
# Cost, in leaps a second, of all exchanged states: without evidence, labels are assumed to be correct.
SWAPPED_COST_PER_S = 0.1


class LabelExchange(NamedTuple):
    """An exchange of labels over the frames first..last.

    Attributes:
        cycle: Marker indices. The samples of each marker are under the next one's label.
        first: Index of the first frame.
        last: Index of the last frame.
        gain: Cost in leaps that undoing the exchange saves.
        counter_evidence: Cost in leaps, by the distances, if these frames were correct and all others exchanged.
    """

    cycle: tuple[int, ...]
    first: int
    last: int
    gain: float
    counter_evidence: float


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
            gain = _compute_saved_step_cost(step_cost, state, first, last) - float(extra_cost[inside].sum())
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


def _compute_saved_step_cost(step_cost: np.ndarray, state: np.ndarray, first: int, last: int) -> float:
    """Compute how much more the steps into first..last + 1 cost with the labels as they are than with the given states."""
    unchanged = state.copy()
    unchanged[first : last + 1] = 0
    t = np.arange(max(first, 1), min(last + 2, len(state)))
    return float((step_cost[t, unchanged[t - 1], unchanged[t]] - step_cost[t, state[t - 1], state[t]]).sum())

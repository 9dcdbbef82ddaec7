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
from numba import njit

from mocapfix.detect.continuity import MarkerTrajectories, compute_leap
from mocapfix.detect.marker_distances import MarkerDistances, compute_contradiction
from mocapfix.stats.runs import find_runs
from mocapfix.stats.viterbi import find_cheapest_states

# Cost, in leaps, of assigning a label to another marker.
LABEL_CHANGE_COST = 0.5
# A label with a smaller leap from one frame to the next continues smoothly, and has not changed its marker.
MAX_SMOOTH_LEAP = 0.25
# Cost, in leaps, of a change of a label that continues smoothly.
SMOOTH_CHANGE_COST = 1000.0
# Duration of a full contradiction that costs as much as one leap.
CONTRADICTION_S_PER_LEAP = 0.05
# Shortest exchange with a label that is missing meanwhile: a shorter one may be a spike.
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
    step_cost, state_cost = _compute_exchange_costs(states, np.array(group), trajectories, distances)
    doubt = SWAPPED_COST_PER_S / trajectories.rate * (np.arange(len(states)) > 0)
    state = find_cheapest_states(step_cost[1:], state_cost + doubt)
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


@njit(cache=True)
def _compute_exchange_costs(states, group, trajectories, distances):
    """Compute the costs in leaps of the step (T, S, S) into a frame's state from the one before, and of the state (T, S)."""
    frames, count = trajectories.previous_frame.shape
    size, n = len(group), len(states)
    is_excluded = np.zeros(count, np.bool_)
    for marker in group:
        is_excluded[marker] = True
    step_cost, state_cost = np.zeros((frames, n, n)), np.zeros((frames, n))
    leaps, is_smooth, misfit = np.zeros((size, size)), np.zeros(size, np.bool_), np.zeros((size, size))
    for t in range(frames):
        for j in range(size):
            visible = not np.isnan(trajectories.markers[t, group[j], 0])
            leaps[j, j] = compute_leap(trajectories, t, group[j], group[j])
            is_consecutive = trajectories.previous_frame[t, group[j]] == t - 1
            is_smooth[j] = visible and is_consecutive and leaps[j, j] < MAX_SMOOTH_LEAP
            for i in range(size):
                contradiction = 0.0
                if visible:
                    contradiction = compute_contradiction(
                        trajectories.markers, distances, t, group[j], group[i], is_excluded, 1.0
                    )
                misfit[i, j] = contradiction / (CONTRADICTION_S_PER_LEAP * trajectories.rate)
        if not is_smooth.all():
            for i in range(size):
                for j in range(size):
                    leaps[i, j] = compute_leap(trajectories, t, group[i], group[j])
        for s in range(n):
            for i in range(size):
                state_cost[t, s] += misfit[i, states[s, i]]
                for r in range(n):
                    before, now = states[r, i], states[s, i]
                    change_cost = LABEL_CHANGE_COST + SMOOTH_CHANGE_COST * is_smooth[before]
                    step_cost[t, r, s] += leaps[before, now] + (before != now) * change_cost
    return step_cost, state_cost

"""Which markers the labels of a small group really follow, frame by frame: the cheapest course through their permutations.

In a state each marker of the group rides on one label of it. A course pays for each leap that its markers make, for samples
that contradict the distances of the markers they are held for, and for each change of state. The cheapest is found exactly,
by dynamic programming (Viterbi's algorithm). All is counted in leaps, 1 being as far as counts, so neither a spike nor a
moment's misfit buys a change; and where labels change within a gap, with no leap to be seen, distances alone can.
"""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.detect.continuity import MarkerTrajectories, compute_leap
from mocapfix.detect.marker_distances import MarkerDistances, compute_contradiction
from mocapfix.stats.runs import find_runs
from mocapfix.stats.viterbi import find_cheapest_states

LABEL_CHANGE_COST = 0.5  # leaps: the price of a label's change from one marker to another
MAX_SMOOTH_LEAP = 0.25  # of a leap: a label that goes on so well from one frame to the next has not changed its marker
SMOOTH_CHANGE_COST = 1000.0  # leaps: the price of saying so all the same
CONTRADICTION_S_PER_LEAP = 0.05  # seconds for which a sample must be wholly contradicted to count as much as a leap
MIN_PARTIAL_SWAP_DURATION_S = (
    0.1  # seconds: a label in the place of one that is not seen meanwhile may be a spike if it is there for less
)
SWAPPED_COST_PER_S = 0.1  # leaps a second: labels are rather right than wrong where nothing tells


class LabelExchange(NamedTuple):
    """A ring of labels over the frames first..last: the samples of each marker in `ring` are under the next one's label.

    gain     leaps that it saves
    against  leaps that it would cost, on the evidence of distances, if these frames were right and all the others wrong
    """

    cycle: tuple[int, ...]
    first: int
    last: int
    gain: float
    counter_evidence: float


def find_exchanges(group: tuple[int, ...], trajectories: MarkerTrajectories, distances: MarkerDistances) -> list[LabelExchange]:
    """-> the exchanges of labels in a group of two or three markers, by first frame."""
    states = np.array(list(permutations(range(len(group)))))  # marker i rides on label states[s, i]; in the first on its own
    step, stay = _compute_exchange_costs(states, np.array(group), trajectories, distances)
    doubt = SWAPPED_COST_PER_S / trajectories.rate * (np.arange(len(states)) > 0)
    course = find_cheapest_states(step[1:], stay + doubt)
    seen, found = ~np.isnan(trajectories.markers[:, group, 0]), []
    for s in range(1, len(states)):
        extra = stay[:, s] - stay[:, 0]
        for first, last in find_runs(course == s):
            inside = slice(first, last + 1)
            gain = _compute_saved_step_cost(step, course, first, last) - float(extra[inside].sum())
            against = float(extra[course == 0].sum() - extra[inside].sum())
            for ring in _find_state_cycles(states[s]):
                there = first + np.flatnonzero(seen[inside][:, ring].any(1))
                whole = seen[inside][:, ring].any(0).all()
                if len(there) >= (1 if whole else MIN_PARTIAL_SWAP_DURATION_S * trajectories.rate):
                    named = tuple(group[i] for i in ring)
                    found.append(LabelExchange(named, int(there[0]), int(there[-1]), gain, against))
    return sorted(found, key=lambda each: each.first)


def _find_state_cycles(state: np.ndarray) -> list[list[int]]:
    """-> the rings of a permutation, those of one alone left out: each is followed by the one on whose label it rides."""
    rings, left = [], set(range(len(state)))
    while left:
        ring = [min(left)]
        while (following := int(state[ring[-1]])) != ring[0]:
            ring.append(following)
        left -= set(ring)
        rings += [ring] if len(ring) > 1 else []
    return rings


def _compute_saved_step_cost(step_cost: np.ndarray, state: np.ndarray, first: int, last: int) -> float:
    """-> leaps and prices of change that the labels as they are would cost more than the course does over first..last."""
    as_is = state.copy()
    as_is[first : last + 1] = 0
    t = np.arange(max(first, 1), min(last + 2, len(state)))
    return float((step_cost[t, as_is[t - 1], as_is[t]] - step_cost[t, state[t - 1], state[t]]).sum())


@njit(cache=True)
def _compute_exchange_costs(states, group, trajectories, distances):
    """-> step (T, S, S) into a frame's state from the one before, and stay (T, S) in a state, all in leaps."""
    frames, count = trajectories.previous_frame.shape
    size, n = len(group), len(states)
    left_out = np.zeros(count, np.bool_)
    for marker in group:
        left_out[marker] = True
    step, stay = np.zeros((frames, n, n)), np.zeros((frames, n))
    leaps, fixed, misfit = np.zeros((size, size)), np.zeros(size, np.bool_), np.zeros((size, size))
    for t in range(frames):
        for j in range(size):
            there = not np.isnan(trajectories.markers[t, group[j], 0])
            leaps[j, j] = compute_leap(trajectories, t, group[j], group[j])
            fixed[j] = there and trajectories.previous_frame[t, group[j]] == t - 1 and leaps[j, j] < MAX_SMOOTH_LEAP
            for i in range(size):
                off = (
                    compute_contradiction(trajectories.markers, distances, t, group[j], group[i], left_out, 1.0) if there else 0.0
                )
                misfit[i, j] = off / (CONTRADICTION_S_PER_LEAP * trajectories.rate)
        if not fixed.all():
            for i in range(size):
                for j in range(size):
                    leaps[i, j] = compute_leap(trajectories, t, group[i], group[j])
        for s in range(n):
            for i in range(size):
                stay[t, s] += misfit[i, states[s, i]]
                for r in range(n):
                    before, now = states[r, i], states[s, i]
                    step[t, r, s] += leaps[before, now] + (before != now) * (
                        LABEL_CHANGE_COST + SMOOTH_CHANGE_COST * fixed[before]
                    )
    return step, stay

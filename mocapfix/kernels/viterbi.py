"""Viterbi's algorithm, compiled; `stats.viterbi` documents it."""

import numpy as np
from numba import njit


@njit(cache=True)
def compute_cheapest_states(step_cost, state_cost):
    """Return (T,) the state of each frame in the sequence of least total cost."""
    frames, states = state_cost.shape
    cost, predecessor = state_cost[0].copy(), np.zeros((frames, states), np.int64)
    total = cost.copy()
    for t in range(1, frames):
        for s in range(states):
            for r in range(states):
                if cost[r] + step_cost[t - 1, r, s] < cost[predecessor[t, s]] + step_cost[t - 1, predecessor[t, s], s]:
                    predecessor[t, s] = r
            total[s] = cost[predecessor[t, s]] + step_cost[t - 1, predecessor[t, s], s] + state_cost[t, s]
        cost[:] = total
    state = np.zeros(frames, np.int64)
    state[-1] = np.argmin(cost)
    for t in range(frames - 1, 0, -1):
        state[t - 1] = predecessor[t, state[t]]
    return state

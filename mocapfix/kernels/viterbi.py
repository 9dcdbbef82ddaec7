"""Least costs over frames, compiled: the cheapest sequence of states (Viterbi) and the cheapest chain of samples."""

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

BEND_TOLERANCE_M_PER_S2 = 200.0
BEND_TOLERANCE_M = 0.010
# Cost of omitting one sample, and the additional cost of the longest run that may be omitted.
OMITTED_SAMPLE_COST = 1.5
OMITTED_RUN_LENGTH_COST = 1.5
OMITTED_EDGE_SAMPLE_COST = 0.75  # next to a gap or at the ends of the take, where omitting a sample causes one bend


@compile_inner_kernel
def _compute_bend(frames, points, rate, a, b, c):
    """Compute how sharply, 0..1, the path bends at sample b between a and c; 1 for the tolerance or more."""
    before, after = (frames[b] - frames[a]) / rate, (frames[c] - frames[b]) / rate
    share, square = before / (before + after), 0.0
    for x in range(3):
        square += (points[a, x] + share * (points[c, x] - points[a, x]) - points[b, x]) ** 2
    return min(1.0, square / (BEND_TOLERANCE_M + BEND_TOLERANCE_M_PER_S2 * before * after / 2) ** 2)


@compile_kernel
def find_cheapest_chain(frames, points, rate, max_omitted):
    """Return the mask (N,) of the samples on the cheapest chain that omits at most `max_omitted` samples in a row.

    cost[i, g] is the cost of the cheapest chain that ends in samples i - g - 1 and i; predecessor[i, g] is its g before.
    It stays infinite if it is larger than that of another chain that ends in i, least[i], and a bend.
    """
    count, steps = len(frames), max_omitted + 1
    cost, predecessor = np.empty((count, steps)), np.empty((count, steps), np.int64)
    for i in range(count):
        for g in range(steps):
            cost[i, g], predecessor[i, g] = np.inf, -1
    least = np.full(count, np.inf)
    price, edge_price = np.zeros(steps), np.zeros(steps)
    for n in range(max_omitted):
        price[n + 1] = edge_price[n + 1] = OMITTED_SAMPLE_COST + OMITTED_RUN_LENGTH_COST * n / max_omitted
    edge_price[1] = OMITTED_EDGE_SAMPLE_COST
    for i in range(1, count):
        for g in range(min(steps, i)):
            j = i - g - 1
            step_price = edge_price[g] if frames[i] - frames[j] > i - j else price[g]
            if j < steps:
                cost[i, g] = edge_price[j] + step_price
            reach = min(steps, j) if least[j] + step_price <= least[i] + 1.0 else 0
            for h in range(reach):
                if cost[j, h] + step_price >= cost[i, g]:
                    continue  # whatever the bend costs
                total = cost[j, h] + step_price + _compute_bend(frames, points, rate, j - h - 1, j, i)
                if total < cost[i, g]:
                    cost[i, g], predecessor[i, g] = total, h
            least[i] = min(least[i], cost[i, g])
    best, i, g = np.inf, count - 1, 0
    for end in range(max(1, count - steps), count):
        for step in range(steps):
            total = cost[end, step] + edge_price[count - 1 - end]
            if total < best:
                best, i, g = total, end, step
    return _trace_chain(predecessor, i, g)


@compile_inner_kernel
def _trace_chain(predecessor, i, g):
    """Return the mask (N,) of the samples on the chain that ends in i - g - 1 and i."""
    is_kept = np.zeros(len(predecessor), np.bool_)
    is_kept[i] = True
    while g >= 0:
        i, g = i - g - 1, predecessor[i, g]
        is_kept[i] = True
    return is_kept


@compile_kernel
def find_cheapest_states(step_cost, state_cost):
    """Return (T,) the state of each frame in the sequence of least total cost (Viterbi 1967).

    Args:
        step_cost: (T - 1, N, N) cost of the step from each state of a frame to each state of the next.
        state_cost: (T, N) cost of each state in each frame.
    """
    frames, states = state_cost.shape
    cost, total, predecessor = np.empty(states), np.empty(states), np.zeros((frames, states), np.int64)
    for s in range(states):
        cost[s] = state_cost[0, s]
    for t in range(1, frames):
        for s in range(states):
            for r in range(states):
                if cost[r] + step_cost[t - 1, r, s] < cost[predecessor[t, s]] + step_cost[t - 1, predecessor[t, s], s]:
                    predecessor[t, s] = r
            total[s] = cost[predecessor[t, s]] + step_cost[t - 1, predecessor[t, s], s] + state_cost[t, s]
        for s in range(states):  # not an assignment to a slice: that compiles the text of its errors
            cost[s] = total[s]
    state = np.zeros(frames, np.int64)
    for s in range(1, states):
        if cost[s] < cost[state[-1]]:
            state[-1] = s
    for t in range(frames - 1, 0, -1):
        state[t - 1] = predecessor[t, state[t]]
    return state

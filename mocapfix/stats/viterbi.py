"""Viterbi's algorithm: the cheapest sequence of states, by dynamic programming."""

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.viterbi import compute_cheapest_states


def find_cheapest_states(
    step_cost: Float[np.ndarray, "steps N N"], state_cost: Float[np.ndarray, "T N"]
) -> Int[np.ndarray, " T"]:
    """Return the state of each frame in the sequence of least total cost (Viterbi 1967).

    step_cost   (T - 1, N, N) cost of the step from each state of a frame to each state of the next
    state_cost  (T, N) cost of each state in each frame
    """
    return compute_cheapest_states(step_cost, state_cost)

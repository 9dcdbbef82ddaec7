"""Detect when a joint stands still: the cheapest sequence of the states moving and standing (Viterbi), by the joint's speed.

The solved motion is smooth already, so its speed is the difference of neighbouring frames. A joint of a foot that bears weight
still rolls: its speed falls to 0.02 to 0.1 m/s, not to 0. The cost of a state is linear in the logarithm of the speed.
"""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.sequences import find_cheapest_states, find_runs

STANDING_SPEED_M_S = 0.09
"""Speed at which standing and moving are equally likely. Chosen on CMU training people: F1 changes by 0.002 from 0.08 to 0.1."""
LOG_SPEED_WIDTH = 0.3
"""Change of the logarithm of the speed that changes the cost by 1."""
MAX_STATE_COST = 3.0
"""Largest cost of a state in a frame: a single fast frame is no proof of a step."""
STANDING_CHANGE_COST = 2.0
"""Cost of a change of state, at the rate for which it was chosen; several frames must contradict a state to change it."""
MIN_STANDING_S = 0.1
"""Shortest time for which a joint stands."""
MIN_SPEED_M_S = 1e-4


def compute_speed(position: Float[np.ndarray, "T 3"], rate: float) -> Float[np.ndarray, " T"]:
    """Return the speed (T,) in m/s of a path in metres."""
    if len(position) < 2:
        return np.zeros(len(position))
    return np.linalg.norm(np.gradient(position, 1 / rate, axis=0), axis=-1)


def detect_standing(
    speed: Float[np.ndarray, " T"], rate: float, is_ignored: Bool[np.ndarray, " T"] | None = None
) -> Bool[np.ndarray, " T"]:
    """Return whether a joint stands in each frame, from its speed in m/s.

    is_ignored  frames whose speed is no evidence: the state there follows from the frames around them
    """
    frames = len(speed)
    if frames < 2:
        return np.zeros(frames, bool)
    ratio = np.log(np.maximum(speed, MIN_SPEED_M_S) / STANDING_SPEED_M_S) / LOG_SPEED_WIDTH
    frame_share = 120.0 / rate  # the costs were chosen at 120 frames per second: slower files have more information in a frame
    state_cost = np.zeros((frames, 2))
    state_cost[:, 1] = np.clip(ratio, -MAX_STATE_COST, MAX_STATE_COST) * frame_share
    if is_ignored is not None:
        state_cost[is_ignored] = 0.0
    step_cost = np.zeros((frames - 1, 2, 2))
    step_cost[:, 0, 1] = step_cost[:, 1, 0] = STANDING_CHANGE_COST
    return remove_short_runs(find_cheapest_states(step_cost, state_cost).astype(bool), rate)


def remove_short_runs(is_standing: Bool[np.ndarray, " T"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the runs of at least MIN_STANDING_S."""
    kept = np.zeros(len(is_standing), bool)
    for first, last in find_runs(is_standing):
        if last + 1 - first >= MIN_STANDING_S * rate - 1e-9:
            kept[first : last + 1] = True
    return kept

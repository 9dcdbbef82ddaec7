"""Ghosts: a label that leaps to a position without a marker, and returns or not.

In each frame a label is in one of two states: on its marker, or elsewhere. The cheapest sequence of states pays for leaps
and for broken distances while the label is on its marker, a constant rate while it is elsewhere, and for each change of
state (compare `label_swaps`). A label that continues smoothly does not change its state. What lasts no longer than a spike
is left to the spike detector. A new position that moves with the segment and is not left again is no ghost, because the
marker itself may have moved.

Swaps have to be undone first, since both labels of a swap look like ghosts.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect.marker_distances import MarkerDistances, estimate_distances
from mocapfix.detect.trajectory_segments import build_trajectories
from mocapfix.faults import Fault
from mocapfix.kernels.label_evidence import (
    CONTRADICTION_S_PER_LEAP,
    MAX_SMOOTH_LEAP,
    SMOOTH_CHANGE_COST,
    compute_own_contradictions,
    compute_own_leaps,
)
from mocapfix.stats.sequences import find_cheapest_states, find_runs
from mocapfix.take import Take

# Fraction of the take in which a marker is assumed to be in place. It is larger than for swaps: a rare pose is no ghost.
GHOST_CORRECT_FRACTION = 0.8
# Cost of a change of state, in leaps.
GHOST_CHANGE_COST = 0.5
# Contradiction for which a label pays while it is elsewhere, whatever its partners show.
ELSEWHERE_CONTRADICTION = 0.5
# Smallest cost, in leaps, that a ghost saves.
MIN_GHOST_GAIN = 1.0
# Number of steadiest partners by which the displacement is measured.
MAX_GHOST_PARTNERS = 3


def detect_ghosts(take: Take, min_distance_m: float = 0.03, max_spike_duration_s: float = 0.05) -> list[Fault]:
    """Detect ghosts that are displaced by more than `min_distance_m` and last longer than `max_spike_duration_s`.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the displacement in metres.
    """
    if take.frame_count < 2 or not take.labels:
        return []
    trajectories = build_trajectories(take.markers, take.rate)
    distances = estimate_distances(take.markers, GHOST_CORRECT_FRACTION)
    leaps = compute_own_leaps(trajectories)
    contradiction = compute_own_contradictions(trajectories.markers, distances, ELSEWHERE_CONTRADICTION)
    ghosts: list[Fault] = []
    for m in range(len(take.labels)):
        visible = np.flatnonzero(take.visible[:, m])
        is_consecutive = np.diff(visible, prepend=-1) == 1
        step_cost, state_cost = _compute_ghost_costs(leaps[visible, m], contradiction[visible, m], is_consecutive, take.rate)
        state = find_cheapest_states(step_cost[1:], state_cost) if len(visible) else np.zeros(0, int)
        for a, b in find_runs(state == 1):
            frames = visible[a : b + 1]
            displacement = _measure_displacement(take.markers[frames], distances, m)
            is_persistent = b == len(visible) - 1 or a == 0
            may_be_moved = is_persistent and displacement.sd_m < min_distance_m / 3
            is_long = len(frames) > max_spike_duration_s * take.rate
            if is_long and displacement.distance_m > min_distance_m and not may_be_moved:
                t = np.arange(max(a, 1), min(b + 2, len(visible)))
                saved_step_cost = (step_cost[t, 0, 0] - step_cost[t, state[t - 1], state[t]]).sum()
                gain = float(saved_step_cost + (state_cost[a : b + 1] @ [1, -1]).sum())
                if gain > MIN_GHOST_GAIN:
                    interval = int(frames[0]), int(frames[-1])
                    ghosts.append(_build_ghost_fault(take, m, interval, displacement.distance_m, gain, is_persistent))
    return ghosts


def _compute_ghost_costs(
    leaps: np.ndarray, contradiction: np.ndarray, is_consecutive: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the costs, in leaps, of N visible samples.

    Args:
        leaps: The leap (N,) to each sample.
        contradiction: The contradiction (N,) of each sample.
        is_consecutive: Whether (N,) a sample follows the one before without a gap.
        rate: Frame rate in Hz.

    Returns:
        The costs (N, 2, 2) of the step into each sample's state, and the costs (N, 2) of the state.
    """
    step_cost = np.broadcast_to(leaps[:, None, None], (len(leaps), 2, 2)).copy()
    is_smooth = is_consecutive & (leaps < MAX_SMOOTH_LEAP)
    step_cost[:, [0, 1], [1, 0]] = (GHOST_CHANGE_COST + SMOOTH_CHANGE_COST * is_smooth)[:, None]
    elsewhere = np.full(len(contradiction), ELSEWHERE_CONTRADICTION)
    return step_cost, np.stack([contradiction, elsewhere], 1) / (CONTRADICTION_S_PER_LEAP * rate)


class _Displacement(NamedTuple):
    """The deviation of a marker's distances to its partners in metres: its size, and its standard deviation over time."""

    distance_m: float
    sd_m: float


def _measure_displacement(markers: np.ndarray, distances: MarkerDistances, marker: int) -> _Displacement:
    """Measure the deviation from the distances to the steadiest partners; NaN if none is visible throughout."""
    partners = distances.partner[marker, :MAX_GHOST_PARTNERS]
    partners = partners[partners >= 0]
    error = np.linalg.norm(markers[:, [marker]] - markers[:, partners], axis=-1) - distances.length_m[marker, : len(partners)]
    error = error[:, ~np.isnan(error).any(0)]
    if not error.size:
        return _Displacement(float("nan"), float("nan"))
    return _Displacement(float(np.median(np.abs(error).max(1))), float(error.std(0).max()))


def _build_ghost_fault(
    take: Take, marker: int, interval: tuple[int, int], distance_m: float, gain: float, is_persistent: bool
) -> Fault:
    first, last = interval
    label, count = take.bare_labels[marker], last - first + 1
    where = f"{label} is {distance_m * 1e3:.0f} mm off its segment for {count / take.rate:.2f} s ({count} frames)"
    reason = f"{where}, at a position without a marker{'' if is_persistent else ', and returns'}."
    return Fault("ghost", marker, first, last, distance_m, reason, float(1 - np.exp(-gain)))

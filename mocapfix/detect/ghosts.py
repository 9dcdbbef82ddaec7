"""Ghosts: a label that leaps to a position without a marker, and returns or not.

In each frame a label is in one of two states: on its marker, or elsewhere. The cheapest sequence of states pays for leaps
and for broken distances while the label is on its marker, a constant rate while it is elsewhere, and for each change of
state (compare `label_swaps`). A label that continues smoothly does not change its state. What lasts no longer than a spike
is left to the spike detector. A new position that moves with the segment and is not left again is no ghost, because the
marker itself may have moved. A label whose distances change gradually at an end has not leapt there: it is a rare pose. If the
marker keeps its distances to its two steadiest partners, or to one that has the same new distances to others, a joint has moved
between them.

Swaps have to be undone first, since both labels of a swap look like ghosts.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import label_evidence
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import MarkerDistances, build_trajectories, estimate_distances
from mocapfix.stats.sequences import find_cheapest_states, find_runs

GHOST_CORRECT_FRACTION = 0.8  # of the take in which a marker is assumed to be in place; larger than for swaps: rare poses
GHOST_CHANGE_COST = 0.5  # cost of a change of state, in leaps
ELSEWHERE_CONTRADICTION = 0.5  # contradiction for which a label pays while it is elsewhere, whatever its partners show
MIN_GHOST_GAIN = 1.0  # smallest cost, in leaps, that a ghost saves
MIN_GHOST_M, MIN_GHOST_S = 0.03, 0.05  # smallest displacement, and the duration of the longest spike
MIN_UNSEEN_GHOST_M = 0.045  # of a ghost that begins and ends in gaps: rare poses between two gaps reach 35 mm in captures
MAX_GHOST_PARTNERS = 3  # number of steadiest partners by which the displacement is measured
MAX_DISTANCE_SAMPLES = 300  # number of frames, evenly spread, from which the usual distance between two partners is computed
MIN_END_CHANGE_RATIO = 0.5  # smallest change of a distance's deviation at an end of a ghost, relative to that within it
MAX_KEPT_DEVIATION_RATIO = 0.15  # of the two steadiest distances that a marker has kept, relative to the largest deviation
MIN_SHARED_DEVIATION_RATIO = 0.5  # of a partner's distance to another, relative to the marker's own, that voids the latter


def detect_ghosts(take: Take) -> list[Fault]:
    """Detect ghosts that are displaced by more than MIN_GHOST_M and last longer than a spike.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the displacement in metres.
    """
    if take.frame_count < 2 or not take.labels:
        return []
    trajectories = build_trajectories(take.markers, take.rate)
    distances = estimate_distances(take.markers, GHOST_CORRECT_FRACTION)
    leaps = label_evidence.compute_own_leaps(trajectories)
    contradiction = label_evidence.compute_own_contradictions(trajectories.markers, distances, ELSEWHERE_CONTRADICTION)
    ghosts: list[Fault] = []
    for m in range(len(take.labels)):
        visible = np.flatnonzero(take.visible[:, m])
        if not (contradiction[visible, m] > ELSEWHERE_CONTRADICTION).any():
            continue  # changes of state alone save less than the smallest gain
        is_consecutive = np.diff(visible, prepend=-1) == 1
        step_cost, state_cost = _compute_ghost_costs(leaps[visible, m], contradiction[visible, m], is_consecutive, take.rate)
        state = find_cheapest_states(step_cost[1:], state_cost)
        for a, b in find_runs(state == 1):
            frames = visible[a : b + 1]
            if not len(frames) > MIN_GHOST_S * take.rate:
                continue
            t = np.arange(max(a, 1), min(b + 2, len(visible)))
            saved_step_cost = (step_cost[t, 0, 0] - step_cost[t, state[t - 1], state[t]]).sum()
            gain = float(saved_step_cost + (state_cost[a : b + 1] @ [1, -1]).sum())
            if not gain > MIN_GHOST_GAIN:
                continue
            is_persistent = b == len(visible) - 1 or a == 0
            off_m, sd_m, is_abrupt = _measure_displacement(take.markers, distances, m, visible, (a, b))
            may_be_moved = is_persistent and sd_m < MIN_GHOST_M / 3
            interval = int(frames[0]), int(frames[-1])
            is_seen = any(0 <= t < take.frame_count and take.visible[t, m] for t in (interval[0] - 1, interval[1] + 1))
            least_m = MIN_GHOST_M if is_seen else MIN_UNSEEN_GHOST_M
            if off_m > least_m and is_abrupt and not may_be_moved:
                count = interval[1] - interval[0] + 1
                where = f"{off_m * 1e3:.0f} mm off its segment for {count / take.rate:.2f} s ({count} frames)"
                end = "" if is_persistent else ", and returns"
                reason = f"{take.bare_labels[m]} is {where}, at a position without a marker{end}."
                ghosts.append(Fault("ghost", m, *interval, off_m, reason, float(1 - np.exp(-gain))))
    return ghosts


def _compute_ghost_costs(
    leaps: Float[np.ndarray, " N"], contradiction: Float[np.ndarray, " N"], is_consecutive: Bool[np.ndarray, " N"], rate: float
) -> tuple[Float[np.ndarray, "N 2 2"], Float[np.ndarray, "N 2"]]:
    """Return the costs, in leaps, of the step into each state of the visible samples, and of the state itself."""
    step_cost = np.broadcast_to(leaps[:, None, None], (len(leaps), 2, 2)).copy()
    is_smooth = is_consecutive & (leaps < label_evidence.MAX_SMOOTH_LEAP)
    step_cost[:, [0, 1], [1, 0]] = (GHOST_CHANGE_COST + label_evidence.SMOOTH_CHANGE_COST * is_smooth)[:, None]
    elsewhere = np.full(len(contradiction), ELSEWHERE_CONTRADICTION)
    return step_cost, np.stack([contradiction, elsewhere], 1) / (label_evidence.CONTRADICTION_S_PER_LEAP * rate)


def _measure_displacement(
    markers: np.ndarray, distances: MarkerDistances, marker: int, visible: Int[np.ndarray, " N"], interval: tuple[int, int]
) -> tuple[float, float, bool]:
    """Measure the deviation from the distances to the steadiest partners in an interval of the frames that show the marker.

    Return its size in metres, NaN if unknown, its standard deviation over time, and whether it changes abruptly at both ends, or
    may do so.
    """
    a, b = interval
    frames, partners = visible[a : b + 1], distances.partner[marker, :MAX_GHOST_PARTNERS]
    partners = partners[partners >= 0]
    partners = partners[~np.isnan(markers[frames][:, partners, 0]).any(0)]
    partners = partners[~_find_shared_deviations(markers, distances, marker, partners, frames)]
    if not partners.size:
        return float("nan"), float("nan"), True
    deviation = _compute_deviations(markers[frames], distances, marker, partners)
    ends = [(frames[0], visible[a - 1])] if a > 0 else []
    ends += [(frames[-1], visible[b + 1])] if b + 1 < len(visible) else []
    is_abrupt = True
    for end in ends:
        at_end = _compute_deviations(markers[[*end]], distances, marker, partners)
        inside, outside = at_end[:, np.abs(at_end[0]).argmax()]
        is_abrupt &= not abs(inside - outside) < MIN_END_CHANGE_RATIO * abs(inside)
    return float(np.median(np.abs(deviation).max(1))), float(deviation.std(0).max()), is_abrupt


def _compute_deviations(markers: np.ndarray, distances: MarkerDistances, marker: int, partners: np.ndarray) -> np.ndarray:
    """Compute the deviations (N, P), in metres, of a marker's distances to partners in N frames, NaN where missing."""
    position = [distances.partner[marker].tolist().index(p) for p in partners.tolist()]
    return np.linalg.norm(markers[:, [marker]] - markers[:, partners], axis=-1) - distances.length_m[marker, position]


def _find_shared_deviations(
    markers: np.ndarray, distances: MarkerDistances, marker: int, partners: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Find the partners (P,) from which the marker has moved away together with others.

    These are all that follow the two steadiest ones if it has not left those, and those from which another partner, which keeps
    its distance to the marker, deviates as the marker does.
    """
    is_shared = np.zeros(len(partners), bool)
    if not len(partners):
        return is_shared
    position = [distances.partner[marker].tolist().index(p) for p in partners.tolist()]
    own_m = np.median(_compute_deviations(markers[frames], distances, marker, partners), axis=0)
    if (np.abs(own_m[:2]) < MAX_KEPT_DEVIATION_RATIO * np.abs(own_m).max()).all():
        return np.arange(len(partners)) >= 2
    sample = markers[:: max(1, len(markers) // MAX_DISTANCE_SAMPLES)]
    for keeper in np.flatnonzero(np.abs(own_m) < distances.tolerance_m[marker, position]):
        path, sampled = (each[:, partners[keeper], None] - each[:, partners] for each in (markers[frames], sample))
        usual_m = np.nanmedian(np.linalg.norm(sampled, axis=-1), axis=0)
        keeper_m = np.median(np.linalg.norm(path, axis=-1) - usual_m, axis=0)
        is_shared |= keeper_m * np.sign(own_m) > MIN_SHARED_DEVIATION_RATIO * np.abs(own_m)
        is_shared[keeper] = False
    return is_shared

"""Ghosts: a label that leaps to a place where none of the markers is, and comes back or not.

A label is its own marker or elsewhere. The cheapest course through these two states pays for leaps and for broken distances while
it is the marker, and a flat rate while it is elsewhere (compare exchanges); a label that goes on smoothly changes
nothing. What lasts no longer than a spike is one. A place that moves with the segment and is not left again is no ghost,
for there the marker itself may have been moved. Swaps are to be undone first, or both labels look like ghosts.
"""

import numpy as np

from mocapfix.detect import continuity, marker_distances
from mocapfix.detect.continuity import compute_own_leaps
from mocapfix.detect.marker_distances import MarkerDistances, compute_own_contradictions
from mocapfix.detect.swap_viterbi import CONTRADICTION_S_PER_LEAP, MAX_SMOOTH_LEAP, SMOOTH_CHANGE_COST
from mocapfix.faults import Fault
from mocapfix.stats.runs import find_runs
from mocapfix.stats.viterbi import find_cheapest_states
from mocapfix.take import Take

GHOST_CORRECT_FRACTION = (
    0.8  # of the take in which a marker is where it should: more than for swaps, for a pose that is rare is no ghost
)
GHOST_CHANGE_COST = 0.5  # leaps: the price of going elsewhere, and of coming back
ELSEWHERE_CONTRADICTION = 0.5  # contradiction by its partners that a label elsewhere pays for, whatever they say
MIN_GHOST_GAIN = 1.0  # leaps: what explains less is none
MAX_GHOST_PARTNERS = 3  # steadiest partners, the median of whose distances says how far off it is


def detect_ghosts(take: Take, min_distance_m: float = 0.03, max_spike_duration_s: float = 0.05) -> list[Fault]:
    """-> the ghosts, by marker and first frame: off by at least `smallest` metres and longer than `longest_spike` seconds."""
    if take.frame_count < 2 or not take.labels:
        return []
    courses, known = (
        continuity.build_trajectories(take.markers, take.rate),
        marker_distances.estimate_distances(take.markers, GHOST_CORRECT_FRACTION),
    )
    leaps, off = compute_own_leaps(courses), compute_own_contradictions(courses.markers, known, ELSEWHERE_CONTRADICTION)
    ghosts = []
    for m in range(len(take.labels)):
        seen = np.flatnonzero(take.visible[:, m])
        step, stay = _compute_ghost_costs(leaps[seen, m], off[seen, m], np.diff(seen, prepend=-1) == 1, take.rate)
        course = find_cheapest_states(step[1:], stay) if len(seen) else np.zeros(0, int)
        for a, b in find_runs(course == 1):
            frames = seen[a : b + 1]
            error, sway = _measure_displacement(take.markers[frames], known, m)
            stays = b == len(seen) - 1 or a == 0
            if (
                len(frames) > max_spike_duration_s * take.rate
                and error > min_distance_m
                and not (stays and sway < min_distance_m / 3)
            ):
                t = np.arange(max(a, 1), min(b + 2, len(seen)))
                gain = float((step[t, 0, 0] - step[t, course[t - 1], course[t]]).sum() + (stay[a : b + 1] @ [1, -1]).sum())
                if gain > MIN_GHOST_GAIN:
                    ghosts.append(_build_ghost_fault(take, m, int(frames[0]), int(frames[-1]), error, gain, stays))
    return ghosts


def _compute_ghost_costs(
    leaps: np.ndarray, contradiction: np.ndarray, follows: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> step (N, 2, 2) and stay (N, 2), in leaps, for N samples that are seen, of which some follow the one before at once."""
    step = np.broadcast_to(leaps[:, None, None], (len(leaps), 2, 2)).copy()
    step[:, [0, 1], [1, 0]] = (GHOST_CHANGE_COST + SMOOTH_CHANGE_COST * (follows & (leaps < MAX_SMOOTH_LEAP)))[:, None]
    return step, np.stack([contradiction, np.full(len(contradiction), ELSEWHERE_CONTRADICTION)], 1) / (
        CONTRADICTION_S_PER_LEAP * rate
    )


def _measure_displacement(markers: np.ndarray, distances: MarkerDistances, marker: int) -> tuple[float, float]:
    """-> metres by which the distances to the steadiest partners are wrong, and by which they sway; NaN where none is seen."""
    judges = distances.partner[marker, :MAX_GHOST_PARTNERS]
    judges = judges[judges >= 0]
    error = np.linalg.norm(markers[:, [marker]] - markers[:, judges], axis=-1) - distances.length_m[marker, : len(judges)]
    error = error[:, ~np.isnan(error).any(0)]
    if not error.size:
        return float("nan"), float("nan")
    return float(np.median(np.abs(error).max(1))), float(error.std(0).max())


def _build_ghost_fault(
    take: Take, marker: int, first: int, last: int, distance_m: float, gain: float, is_persistent: bool
) -> Fault:
    label, frames = take.bare_labels[marker], last - first + 1
    where = f"{label} is {distance_m * 1e3:.0f} mm off its segment for {frames / take.rate:.2f} s ({frames} frames)"
    reason = f"{where}, where no marker is{'' if is_persistent else ', and comes back'}."
    return Fault("ghost", marker, first, last, distance_m, reason, float(1 - np.exp(-gain)))

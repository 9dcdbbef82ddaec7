"""Rigid groups: markers that keep their distances while they move against the others, such as those of a box or a wheelchair."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.sequences import sample_evenly

MAX_GROUP_FRAMES = 200
"""Frames, evenly spread, in which distances are compared."""
MIN_SHARED_FRAMES = 20
"""Frames in which two markers must be visible together, or a third of the compared frames of a short take."""
DISTANCE_QUANTILES = (0.05, 0.95)
"""Range of a distance over the take; swaps and spikes lie outside of it."""
QUANTILE_RANGE_SD = 3.29
"""Width of this range in standard deviations of a normal distribution."""
MAX_RIGID_SPREAD_M = 0.003
"""Variation of the distances within a rigid group, as a standard deviation; skin moves more between most markers of a segment."""
MIN_GROUP_MARKERS = 3
"""Markers that define the pose of a group."""
MIN_GROUP_MOTION_M = 0.02
"""Variation of the distances from a group to other markers, which shows that it moves as one; at rest, everything is rigid."""


@dataclass(frozen=True)
class RigidGroup:
    """Markers of a take that move as one rigid body.

    markers   indices of the markers, rising
    spread_m  largest variation of a distance within the group, as a standard deviation
    motion_m  median variation of the distances from the group to the other markers; NaN if there are none
    name      the name of the group in reports
    """

    markers: tuple[int, ...]
    spread_m: float
    motion_m: float
    name: str = ""


def measure_distance_spread(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "M M"]:
    """Return the variation of the distance of each pair of markers in metres, as a standard deviation.

    It is infinite where two markers are rarely visible together, and on the diagonal.
    """
    sampled = markers[sample_evenly(len(markers), MAX_GROUP_FRAMES)]
    count = sampled.shape[1]
    min_frames = min(MIN_SHARED_FRAMES, len(sampled) // 3 + 2)
    spread = np.full((count, count), np.inf)
    for m in range(1, count):
        distance = np.sort(np.linalg.norm(sampled[:, m, None] - sampled[:, :m], axis=-1), axis=0)  # NaN comes last
        known = (~np.isnan(distance)).sum(0)
        others = np.flatnonzero(known >= min_frames)
        low, high = (distance[np.round(quantile * (known[others] - 1)).astype(int), others] for quantile in DISTANCE_QUANTILES)
        spread[m, others] = spread[others, m] = (high - low) / QUANTILE_RANGE_SD
    return spread


def find_rigid_groups(markers: Float[np.ndarray, "T M 3"], max_spread_m: float = MAX_RIGID_SPREAD_M) -> tuple[RigidGroup, ...]:
    """Return the rigid groups of a take's markers (in metres, NaN if not visible), the largest first.

    Groups are joined while no distance within them varies by more than `max_spread_m` (complete linkage). A group must move
    against the other markers.
    """
    return group_rigid_markers(measure_distance_spread(markers), max_spread_m)


def group_rigid_markers(
    distance_spread: Float[np.ndarray, "M M"], max_spread_m: float = MAX_RIGID_SPREAD_M
) -> tuple[RigidGroup, ...]:
    """Return the rigid groups as `find_rigid_groups`, from the variations of the distances."""
    linkage, members = distance_spread.copy(), {m: [m] for m in range(len(distance_spread))}
    np.fill_diagonal(linkage, np.inf)
    while len(members) > 1 and linkage.min() <= max_spread_m:
        a, b = sorted(int(index) for index in np.unravel_index(int(linkage.argmin()), linkage.shape))
        members[a] += members.pop(b)
        linkage[a] = linkage[:, a] = np.maximum(linkage[a], linkage[b])
        linkage[b], linkage[:, b], linkage[a, a] = np.inf, np.inf, np.inf
    groups = [measure_group(sorted(group), distance_spread) for group in members.values() if len(group) >= MIN_GROUP_MARKERS]
    moving = [group for group in groups if not group.motion_m < MIN_GROUP_MOTION_M]
    return tuple(sorted(moving, key=lambda group: -len(group.markers)))


def measure_group(markers: list[int], distance_spread: Float[np.ndarray, "M M"], name: str = "") -> RigidGroup:
    """Return two or more markers as a group, with its measures; the spread is infinite where two are rarely visible together."""
    others = np.setdiff1d(np.arange(len(distance_spread)), markers)
    within = distance_spread[markers][:, markers][np.triu_indices(len(markers), 1)]
    outside = distance_spread[markers][:, others]
    known = outside[np.isfinite(outside)]
    return RigidGroup(tuple(markers), float(within.max()), float(np.median(known)) if len(known) else float("nan"), name)


def find_prop_groups(distance_spread: Float[np.ndarray, "M M"], is_on_body: Bool[np.ndarray, " M"]) -> tuple[RigidGroup, ...]:
    """Return the rigid groups of those markers that are not on the body."""
    free = np.flatnonzero(~is_on_body)
    groups = group_rigid_markers(distance_spread)
    return tuple(group for group in groups if set(group.markers).issubset(free.tolist()))

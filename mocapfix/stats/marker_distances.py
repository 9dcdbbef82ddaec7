"""Distances between markers, learned from the take itself, and how badly a sample contradicts them.

Two markers on the same segment keep their distance (Ringer & Lasenby 2004, "A procedure for automatically estimating model
parameters in optical motion capture"). Which ones do, and how well, is estimated from the take. A sample under the wrong label
breaks the distances to its label's partners and keeps those to another marker's partners. Each partner has one bounded vote, so
that a faulty or mislabelled partner cannot outvote the others.

The trajectories of labels, with the latest earlier sample of each, are what `kernels.label_evidence` compares besides.

Rigid groups are markers that keep their distances while they move against the others, such as those of a box or a wheelchair.
"""

from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.sequences import sample_evenly

MAX_DISTANCE_PARTNERS = 8  # number of partners of a marker
MAX_PARTNER_SD_M = 0.03  # a distance with a larger standard deviation does not identify a marker
MIN_DISTANCE_SD_M = 0.003  # standard deviation of a distance even on a rigid segment
BROKEN_DISTANCE_SD = 3.0  # a distance is fully broken from this many standard deviations
MAX_DISTANCE_FRAMES = 300  # number of frames, evenly spread, from which the distances are learned
MIN_JOINT_FRAMES = 20  # number of these frames, or all of them if there are fewer, in which both markers must be visible
MIN_CORRECT_FRACTION = 0.55  # fraction of the frames in which a distance is assumed to be correct
# No body has more markers. In takes of more, only the distances between markers are estimated that are ever nearer than this,
# in every so many of the frames: a segment is smaller.
MAX_BODY_MARKERS = 250
MAX_NEAR_DISTANCE_M = 1.0
NEAR_FRAME_STEP = 10


class MarkerDistances(NamedTuple):
    """The distances of each of M markers to its K partners with the steadiest distances."""

    partner: np.ndarray  # marker indices (M, K), steadiest first, -1 where there are fewer
    length_m: np.ndarray  # distances (M, K) in metres
    tolerance_m: np.ndarray  # deviations (M, K) in metres from which a distance is broken


def estimate_distances(
    markers: Float[np.ndarray, "T M 3"], min_correct_fraction: float = MIN_CORRECT_FRACTION
) -> MarkerDistances:
    """Estimate the distances that markers keep over a fraction of the take.

    Args:
        min_correct_fraction: Fraction of the frames in which the distances are assumed to be correct.
    """
    count = markers.shape[1]
    length_m, sd_m = estimate_distance_statistics(markers, min_correct_fraction)
    order = np.argsort(sd_m, axis=1, kind="stable")[:, :MAX_DISTANCE_PARTNERS]
    rows = np.arange(count)[:, None]
    is_steady = sd_m[rows, order] < MAX_PARTNER_SD_M
    tolerance_m = BROKEN_DISTANCE_SD * np.hypot(np.where(is_steady, sd_m[rows, order], 0), MIN_DISTANCE_SD_M)
    return MarkerDistances(np.where(is_steady, order, -1), np.where(is_steady, length_m[rows, order], 0), tolerance_m)


def estimate_distance_statistics(
    markers: Float[np.ndarray, "T M 3"], min_correct_fraction: float
) -> tuple[Float[np.ndarray, "M M"], Float[np.ndarray, "M M"]]:
    """Estimate the centre and the robust standard deviation of the distances between markers, in metres.

    Both are taken from the shortest interval that holds `min_correct_fraction` of the frames, so that the size of the other
    deviations does not matter. They are infinite for markers that are hardly ever visible together, for a marker and itself,
    and in a take of several hundred markers for those that are never near one another.
    """
    count = markers.shape[1]
    centre, sd = np.full((count, count), np.inf), np.full((count, count), np.inf)
    coordinates = sample_coordinates(markers)
    for i in range(1, count):
        others = slice(i) if count <= MAX_BODY_MARKERS else _find_near(i, coordinates[:, : i + 1])
        centre[i, others], sd[i, others] = estimate_distances_from(i, coordinates, others, min_correct_fraction)
        centre[others, i], sd[others, i] = centre[i, others], sd[i, others]
    return centre, sd


def sample_coordinates(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "3 M S"]:
    """Return the coordinates in the frames, evenly spread, from which distances are learned."""
    frames = len(markers)
    sample = markers[np.unique(np.linspace(0, frames - 1, MAX_DISTANCE_FRAMES).astype(int))] if frames else markers
    return np.ascontiguousarray(sample.transpose(2, 1, 0))


def _find_near(marker: int, coordinates: Float[np.ndarray, "3 M S"]) -> Int[np.ndarray, " N"]:
    """Find the other markers that are less than MAX_NEAR_DISTANCE_M from a marker in any of a few frames."""
    few = coordinates[:, :, ::NEAR_FRAME_STEP]
    x, y, z = (few - few[:, marker, None]) ** 2
    is_near = (x + y + z < MAX_NEAR_DISTANCE_M**2).any(1)
    is_near[marker] = False
    return np.flatnonzero(is_near)


def estimate_distances_from(
    marker: int, coordinates: Float[np.ndarray, "3 M S"], others: slice | Int[np.ndarray, " N"], min_correct_fraction: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Estimate the centres and the standard deviations of a marker's distances to others, in metres."""
    x, y, z = (coordinates[:, others] - coordinates[:, marker, None]) ** 2
    distance = np.sort(np.sqrt(x + y + z), axis=1)  # NaN sorts last
    centre, sd = np.full(len(distance), np.inf), np.full(len(distance), np.inf)
    visible_count = (~np.isnan(distance)).sum(1)
    known = np.flatnonzero(visible_count >= max(2, min(MIN_JOINT_FRAMES, coordinates.shape[2])))
    start_m, width_m = _find_shortest_intervals(distance[known], visible_count[known], min_correct_fraction)
    centre[known] = start_m + width_m / 2
    # the standard deviation of a normal distribution with the same central interval
    sd[known] = width_m / 2 / NormalDist().inv_cdf((1 + min_correct_fraction) / 2)
    return centre, sd


def _find_shortest_intervals(
    ordered: Float[np.ndarray, "N S"], counts: Int[np.ndarray, " N"], fraction: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Find the shortest interval that holds a fraction of the values of each row, which ascend; return its start and width."""
    if not len(counts):
        return np.empty(0), np.empty(0)
    rows, inside = np.arange(len(counts)), np.ceil(fraction * counts).astype(int)
    first = np.arange((counts - inside).max() + 1)
    last = first + inside[:, None] - 1
    width = ordered[rows[:, None], np.minimum(last, counts[:, None] - 1)] - ordered[:, : len(first)]
    width[last >= counts[:, None]] = np.inf
    start = width.argmin(1)
    return ordered[rows, start], width[rows, start]


class MarkerTrajectories(NamedTuple):
    """The trajectories of M labels over T frames."""

    markers: np.ndarray  # world positions (T, M, 3) in metres, NaN where missing
    previous_frame: np.ndarray  # index (T, M) of the latest earlier frame in which the label is visible, -1 if there is none
    rate: float  # frame rate in Hz


def build_trajectories(markers: Float[np.ndarray, "T M 3"], rate: float) -> MarkerTrajectories:
    """Build the trajectories of markers at world positions in metres (NaN where missing), at `rate` Hz."""
    markers = np.ascontiguousarray(markers, float)
    visible = ~np.isnan(markers[..., 0])
    latest = np.maximum.accumulate(np.where(visible, np.arange(len(visible))[:, None], -1), axis=0)
    previous_frame = np.full(visible.shape, -1)
    previous_frame[1:] = latest[:-1]
    return MarkerTrajectories(markers, previous_frame, float(rate))


MAX_GROUP_FRAMES = 200  # frames, evenly spread, in which distances are compared
MIN_SHARED_FRAMES = 20  # frames in which two markers must be visible together, or a third of the compared frames of a short take
DISTANCE_QUANTILES = (0.05, 0.95)  # range of a distance over the take; swaps and spikes lie outside of it
QUANTILE_RANGE_SD = 3.29  # width of this range in standard deviations of a normal distribution
# Variation of the distances within a rigid group, as a standard deviation; skin moves more between most markers of a segment.
MAX_RIGID_SPREAD_M = 0.003
MIN_GROUP_MARKERS = 3  # markers that define the pose of a group
# Variation of the distances from a group to other markers, which shows that it moves as one; at rest, everything is rigid.
MIN_GROUP_MOTION_M = 0.02


@dataclass(frozen=True)
class RigidGroup:
    """Markers of a take that move as one rigid body."""

    markers: tuple[int, ...]  # indices of the markers, rising
    spread_m: float  # largest variation of a distance within the group, as a standard deviation
    motion_m: float  # median variation of the distances from the group to the other markers; NaN if there are none
    name: str = ""  # the name of the group in reports


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


def find_rigid_groups(
    distance_spread: Float[np.ndarray, "M M"], max_spread_m: float = MAX_RIGID_SPREAD_M
) -> tuple[RigidGroup, ...]:
    """Return the rigid groups of a take's markers, the largest first, from the variations of their distances in metres.

    Groups are joined while no distance within them varies by more than `max_spread_m` (complete linkage). A group must move
    against the other markers.
    """
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
    groups = find_rigid_groups(distance_spread)
    return tuple(group for group in groups if set(group.markers).issubset(free.tolist()))

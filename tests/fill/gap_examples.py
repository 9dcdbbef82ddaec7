"""Gaps of test takes, as estimators get them."""

from collections.abc import Sequence

import numpy as np

from mocapfix.fill.gap_windows import Gap, MarkerEstimate, MarkersInTake, choose_hidden_stretches, compute_variation_growth
from mocapfix.fill.neighbour_clusters import measure_distance_changes
from mocapfix.model.body_fit import BodyFit
from mocapfix.stats.marker_distances import RigidGroup

RATE = 100.0


def build_take(
    markers: np.ndarray,
    others: MarkerEstimate | None = None,
    *,
    rate: float = RATE,
    body: BodyFit | None = None,
    rigid_groups: Sequence[RigidGroup] = (),
) -> MarkersInTake:
    """Return markers (T, M, 3) with other estimates of the missing ones; none without `others`."""
    nothing = MarkerEstimate(
        np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan), np.zeros(markers.shape[:2], np.int8)
    )
    changes = measure_distance_changes(markers) if markers.size else np.zeros((markers.shape[1],) * 2)
    return MarkersInTake(markers, markers.copy(), others or nothing, changes, rate, body, rigid_groups)


def build_gap(take: MarkersInTake, marker: int, first: int, last: int, **fields) -> Gap:
    """Return a gap of a marker. Its neighbours are all markers that are known throughout, the steadiest first."""
    window = choose_hidden_stretches(take.is_known[:, marker], first, last, take.rate)
    change = take.distance_change_m[marker]
    order = np.argsort(change, kind="stable")
    is_neighbour: np.ndarray = np.all(take.is_known[first : last + 1], axis=0)
    neighbours = order[is_neighbour[order] & np.isfinite(change[order])]
    growth = compute_variation_growth(take.is_known[:, marker], window.length / take.rate, take.rate)
    frames = window.list_frames(np.arange(len(take.markers)), len(take.markers))
    return Gap(
        marker, window, np.array([marker]), neighbours, *frames, activity=1.0, speed_m_s=1.0, variation_growth=growth
    )._replace(**fields)

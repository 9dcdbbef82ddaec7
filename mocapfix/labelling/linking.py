"""Tracklets: points are linked from frame to frame where it is certain which one continues which.

The points of a frame may be in no order at all, as cameras give them before a program has made trajectories of them. Then the
links are found by motion alone (`link_points`). Where each column is a trajectory, a column is continued unless its points leap,
or leap to where another one was going (`cut_columns`).

Points are linked forwards and backwards in time. A link that one direction gives counts unless the other contradicts it. A
tracklet ends where its continuation is ambiguous: a later step that knows the body joins tracklets, but divides none.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.kernels.point_linking import combine_links, link_in_order, number_tracklets
from mocapfix.labelling.points import UnlabelledPoints

# Longest time for which a point may be missing within a tracklet.
MAX_MISSING_S = 0.1
# Smallest difference of cost, twice the logarithm of a ratio of probabilities, to every other way to link the points.
LINK_MARGIN = 6.0
# Evidence, in the same unit, for a point in the same column where columns are trajectories.
COLUMN_GAIN = 10.0
# Number of pairs of frames, evenly spread, from which it is decided whether points are in order.
MAX_ORDER_FRAMES = 200
# In points in no order, a larger share of the points is closer to another column's next point than to that of their own.
MIN_UNORDERED_SHARE = 0.5


def find_tracklets(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide the points of a take into tracklets, whether or not each column is a trajectory.

    Args:
        positions: metres, NaN where missing.
        rate: frames per second.
    """
    return link_points(positions, rate) if are_points_unordered(positions) else cut_columns(positions, rate)


def link_points(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide points in no order into tracklets. Arguments as for `find_tracklets`."""
    return _link(positions, rate, column_gain=0.0)


def cut_columns(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide columns, each of which is a trajectory or several, into tracklets: at leaps and at long gaps.

    A tracklet may change its column where a trajectory goes on in another one. Arguments as for `find_tracklets`.
    """
    return _link(positions, rate, column_gain=COLUMN_GAIN)


def _link(positions: np.ndarray, rate: float, column_gain: float) -> UnlabelledPoints:
    points, max_frames = np.ascontiguousarray(positions, float), max(1, round(MAX_MISSING_S * rate))
    forward = link_in_order(points, float(rate), max_frames, LINK_MARGIN, column_gain)
    backward = link_in_order(np.ascontiguousarray(points[::-1]), float(rate), max_frames, LINK_MARGIN, column_gain)
    return UnlabelledPoints(points, number_tracklets(points, combine_links(forward, backward)), rate)


def are_points_unordered(positions: Float[np.ndarray, "T C 3"]) -> bool:
    """Return whether the columns of points (NaN where missing) are in no order, so that no column is a trajectory."""
    has_point = ~np.isnan(positions[..., 0])
    pairs = np.flatnonzero((has_point[:-1] & has_point[1:]).any(1))
    is_nearer_to_another: list[np.ndarray] = []
    for t in pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_ORDER_FRAMES)).astype(int))]:
        next_columns = np.flatnonzero(has_point[t + 1])
        columns = np.flatnonzero(has_point[t] & has_point[t + 1])
        distance = np.linalg.norm(positions[t, columns, None] - positions[t + 1, next_columns], axis=-1)
        is_nearer_to_another.append(next_columns[distance.argmin(1)] != columns)
    return bool(is_nearer_to_another) and float(np.concatenate(is_nearer_to_another).mean()) > MIN_UNORDERED_SHARE

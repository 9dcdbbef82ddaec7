"""Left and right of a marker set: which marker is which one's twin, and which twins would be exchanged together."""

import numpy as np

from mocapfix.detect import laid
from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import cmu31

MIRROR = np.array([-1.0, 1.0, 1.0])  # the body rests facing +Z, so left and right differ in x


def twins(marker_set: MarkerSet) -> np.ndarray:
    """-> (K,) the index of each marker's twin on the other side; its own where it has none or is in the middle."""
    rest = laid.rest(marker_set)
    nearest = np.linalg.norm(rest[:, None] * MIRROR - rest[None], axis=-1).argmin(1)
    own = np.arange(len(rest))
    return np.where(nearest[nearest] == own, nearest, own)


def groups(marker_set: MarkerSet) -> list[np.ndarray]:
    """-> the exchanges (K,) of left and right of each segment, and of each with all that hangs on it: a limb, the whole body."""
    parents, own, twin = cmu31().skeleton.parents, np.arange(len(marker_set.joints)), twins(marker_set)
    found = {}
    for joint in range(len(parents)):
        hanging = np.zeros(len(parents), bool)
        hanging[joint] = True
        for below in range(joint + 1, len(parents)):
            hanging[below] = hanging[parents[below]]
        for together in (marker_set.joints == joint, hanging[marker_set.joints]):
            touched = together | together[twin]
            exchange = np.where(touched, twin, own)
            if (exchange != own).sum() > 2:  # of two alone they are a pair like any other
                found[tuple(exchange)] = exchange
    return list(found.values())


def one_sided(rings: list[tuple[int, ...]], twin: np.ndarray) -> list[tuple[int, ...]]:
    """-> the rings of markers but for those that the other side's twins (K,) make as well: a habit, not a mistake."""
    there = [set(ring) for ring in rings]
    return [ring for ring in rings if (other := set(twin[list(ring)].tolist())) == set(ring) or other not in there]

"""Filling from the markers that move rigidly with the missing one: those on the same head, forearm, plate or prop.

Two markers of one rigid thing keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture", section 2). Each gap is filled from the markers seen all through
it that keep theirs best, by weighted registration; what that misses at the gap's edges (skin, a joint in between) is carried
across in the cluster's own axes.
"""

import numpy as np

from mocapfix.kernels.course import across
from mocapfix.kernels.registration import centred, fitted
from mocapfix.take import runs

LOOSE = 0.025  # metres: a distance that varies by more is no sign of one rigid thing
NOISE = 0.001  # metres: by what cameras let even a rigid distance vary
MOST = 6  # markers asked for one place
FRAMES = 300  # of the take, from which the distances are learnt
RIDGE = 0.01  # metres: changes of a cluster's own shape that mean nothing
LEARN = 30  # frames
FADE = 0.35  # seconds after which what a cluster missed at an edge has lost most of its memory
REACH = 0.1  # seconds on either side of a gap that are listened to
LEAST = 0.001  # metres: what a cluster misses at the very least


def rigid(markers: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres at missing samples, NaN where no cluster tells, and their deviation per axis (T, M).

    markers  (T, M, 3) metres, NaN where not believed; rate in Hz
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    change = changes(markers)
    for m in np.flatnonzero(~seen.all(0) & seen.any(0)):
        near = np.argsort(change[m])
        near = near[change[m, near] < LOOSE]
        for first, last in runs(~seen[:, m]):
            asked = [k for k in near if seen[first : last + 1, k].all()][:MOST]
            if len(asked) >= 3:
                gap = slice(first, last + 1)
                place, sure = carried(markers, m, np.array(asked), change[m, asked], first, last, rate)
                filled[gap, m], deviation[gap, m] = place, sure
    return filled, deviation


def changes(markers: np.ndarray) -> np.ndarray:
    """-> (M, M) metres: by how much the distance of two markers varies over the take, robustly; infinite where not known."""
    some = markers[np.unique(np.linspace(0, len(markers) - 1, FRAMES).astype(int))]
    change = np.full((markers.shape[1],) * 2, np.inf)
    enough = np.flatnonzero((~np.isnan(some[..., 0])).sum(0) >= 10)
    for i in enough:
        distance = np.linalg.norm(some[:, enough] - some[:, i, None], axis=-1)
        together = (~np.isnan(distance)).sum(0) >= 10
        low, high = np.nanpercentile(distance[:, together], [16, 84], axis=0)
        change[i, enough[together]] = (high - low) / 2
    np.fill_diagonal(change, np.inf)
    return change


def carried(markers, m, asked, change, first, last, rate) -> tuple[np.ndarray, np.ndarray]:
    """-> places (T', 3) and deviation (T',) of marker m over first..last, from the markers `asked` (K,)."""
    gap, span = last + 1 - first, max(1, round(REACH * rate))
    learn = np.flatnonzero(~np.isnan(markers[:, np.r_[asked, m], 0]).any(1))
    if len(learn) < LEARN:
        return np.full((gap, 3), np.nan), np.full(gap, np.nan)
    learn = learn[np.unique(np.linspace(0, len(learn) - 1, FRAMES).astype(int))]
    frames = np.arange(max(0, first - span), min(len(markers), last + 1 + span))
    both = markers[np.r_[learn, frames]]
    others, turn, here = laid(both[:, asked], 1 / (change**2 + NOISE**2))
    own = np.einsum("ta,tab->tb", both[:, m] - here, turn)
    n = len(learn)
    told, size = regressed(others.reshape(len(both), -1), own, n)
    wanted = (frames >= first) & (frames <= last)
    residual = (own - told)[n:]
    course, variance = across(residual, wanted, rate, FADE, REACH, NOISE / 10, max(size, LEAST))
    place = np.einsum("tab,tb->ta", turn[n:], told[n:] + course) + here[n:]
    return place[wanted], np.sqrt(variance[wanted])


def laid(cluster, weight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> the cluster (T, K, 3) in its own axes, its rotations (T, 3, 3) and centres (T, 3); frames with NaN give no axes."""
    there = ~np.isnan(cluster).any((1, 2))
    weights = np.broadcast_to(weight, cluster.shape[:2])
    solid = np.where(there[:, None, None], cluster, 0.0)
    shape = cluster[there][0]
    shape = shape - weight @ shape / weight.sum()
    for _ in range(3):
        cross, here, _ = centred(solid, shape, weights)
        turn = fitted(cross)
        inside = np.einsum("tka,tab->tkb", solid - here[:, None], turn)
        shape = inside[there].mean(0)
    here[~there] = np.nan
    return inside, turn, here


def regressed(told, own, n) -> tuple[np.ndarray, float]:
    mean, centre = told[:n].mean(0), own[:n].mean(0)
    x, y = told - mean, own[:n] - centre

    def gain(rows):
        return np.linalg.solve(x[rows].T @ x[rows] / len(rows) + RIDGE**2 * np.eye(x.shape[1]), x[rows].T @ y[rows] / len(rows))

    blocks = np.array_split(np.arange(n), 4)
    missed = np.concatenate([y[b] - x[b] @ gain(np.setdiff1d(np.arange(n), b)) for b in blocks])
    return centre + x @ gain(np.arange(n)), float(np.sqrt(np.median(missed**2) * 2.2))

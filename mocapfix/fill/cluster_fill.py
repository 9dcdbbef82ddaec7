"""Filling from the markers that move with the missing one: those on the same head, forearm, plate or prop, and its neighbours.

Two markers of one rigid thing keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"). Each gap is filled from the markers seen all through it that keep
theirs best: they make a frame of axes by weighted registration, and how their own shape changes there (a joint in between,
skin) tells, by a regression learnt from the take, where the missing one lies in it. What that misses at the gap's edges is
carried across. So a rigid cluster is exact, and a loose one as good as its past.
"""

import numpy as np

from mocapfix.stats.residual_process import interpolate_residual
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations, transform_to_body_axes
from mocapfix.stats.runs import find_runs

MAX_DISTANCE_CHANGE_M = 0.1  # metres: a distance that varies by more tells nothing
MIN_DISTANCE_CHANGE_M = 0.003  # metres: by which even a distance on one rigid thing varies
MAX_CLUSTER_MARKERS = 12  # markers asked for one place
MIN_CLUSTER_FRAMES = 30  # frames in which the missing one and all that are asked were seen, without which nothing can be learnt
MAX_CLUSTER_TRAINING_FRAMES = 300  # frames at most, evenly spread, from which distances and shapes are learnt
SHAPE_RIDGE_M = 0.01  # metres: a change of a cluster's own shape that means nothing
CROSS_VALIDATION_FOLDS = 4  # stretches of the take, each foretold from the others, to know how sure the regression is
CLUSTER_RESIDUAL_FADE_S = 0.3  # seconds after which what was missed at an edge has lost most of its memory
CLUSTER_RESIDUAL_REACH_S = 0.1  # seconds on either side of a gap that are listened to
CLUSTER_SAMPLE_NOISE_M = 0.0005  # metres: what a single sample is off
MIN_CLUSTER_RESIDUAL_M = 0.001  # metres: what a cluster misses at the very least


def fill_from_clusters(markers: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres at missing samples, NaN elsewhere, and their standard deviation per axis (T, M).

    A gap through which fewer than three markers are seen that ever kept near the missing one is left NaN.

    markers  (T, M, 3) metres, NaN where not believed; rate in Hz
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    if seen.all() or not seen.any():
        return filled, deviation
    change = compute_distance_changes(markers)
    for m in np.flatnonzero(~seen.all(0) & seen.any(0)):
        near = np.argsort(change[m], kind="stable")
        near = near[change[m, near] < MAX_DISTANCE_CHANGE_M]
        for first, last in find_runs(~seen[:, m]):
            asked = near[seen[first : last + 1, near].all(0)][:MAX_CLUSTER_MARKERS]
            learn = np.flatnonzero(seen[:, m] & seen[:, asked].all(1))
            if len(asked) >= 3 and len(learn) >= MIN_CLUSTER_FRAMES:
                gap = slice(first, last + 1)
                weight = 1 / (change[m, asked] ** 2 + MIN_DISTANCE_CHANGE_M**2)
                filled[gap, m], deviation[gap, m] = fill_gap_from_cluster(
                    markers, int(m), asked, weight, sample_evenly(learn), first, last, rate
                )
    return filled, deviation


def sample_evenly(frames: np.ndarray) -> np.ndarray:
    """-> at most LEARNING of the frames, evenly spread."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, MAX_CLUSTER_TRAINING_FRAMES).astype(int))]


def compute_distance_changes(markers: np.ndarray) -> np.ndarray:
    """-> (M, M) metres: by how much the distance of two markers varies over the take, robustly; infinite where not known."""
    some = markers[sample_evenly(np.arange(len(markers)))]
    enough = np.flatnonzero((~np.isnan(some[..., 0])).sum(0) >= min(MIN_CLUSTER_FRAMES, len(some) // 10 + 2))
    change = np.full((markers.shape[1],) * 2, np.inf)
    for n, i in enumerate(enough[1:], start=1):
        distance = np.sort(np.linalg.norm(some[:, i, None] - some[:, enough[:n]], axis=-1), axis=0)  # NaN comes last
        low, high = (compute_column_percentiles(distance, share) for share in (0.16, 0.84))
        known = np.isfinite(high)
        others = enough[:n][known]
        change[i, others] = change[others, i] = (high[known] - low[known]) / 2  # a normal distribution's standard deviation
    return change


def compute_column_percentiles(ordered: np.ndarray, share: float) -> np.ndarray:
    """-> (N,) what that share of the numbers in each column of `ordered` (T, N) lies below; infinite for fewer than two.

    Each column ascends; NaN at its end does not count.
    """
    count = (~np.isnan(ordered)).sum(0)
    last, columns = np.maximum(count - 1, 0), np.arange(ordered.shape[1])
    place = share * last
    below = place.astype(int)
    above = np.minimum(below + 1, last)
    between = ordered[below, columns] + (place - below) * (ordered[above, columns] - ordered[below, columns])
    return np.where(count >= 2, between, np.inf)


def fill_gap_from_cluster(
    markers: np.ndarray,
    marker: int,
    cluster_markers: np.ndarray,
    weight: np.ndarray,
    training_frames: np.ndarray,
    first: int,
    last: int,
    rate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """-> places (G, 3) and deviation (G,) of marker m over first..last, from the markers `asked` (K,), by their weight (K,)."""
    reach = max(1, round(CLUSTER_RESIDUAL_REACH_S * rate))
    frames = np.arange(max(0, first - reach), min(len(markers), last + 1 + reach))
    frames = frames[~np.isnan(markers[np.ix_(frames, cluster_markers)][..., 0]).any(1)]
    n, rows = len(training_frames), np.r_[training_frames, frames]
    cluster, turn, centre = align_cluster(markers[np.ix_(rows, cluster_markers)], weight)
    own = transform_to_body_axes(markers[rows, marker][:, None], centre, turn)[:, 0]
    told, missed = regress_positions(cluster.reshape(len(rows), -1), own[:n])
    residual = np.full((frames[-1] - frames[0] + 1, 3), np.nan)  # the frames beside a gap need not be in a row
    residual[frames - frames[0]] = (own - told)[n:]
    gap = np.arange(first, last + 1)
    wanted = np.zeros(len(residual), bool)
    wanted[gap - frames[0]] = True
    course, variance, _ = interpolate_residual(
        residual,
        wanted,
        rate,
        time_scale_s=CLUSTER_RESIDUAL_FADE_S,
        margin_s=CLUSTER_RESIDUAL_REACH_S,
        noise_sd=CLUSTER_SAMPLE_NOISE_M,
        min_sd=max(missed, MIN_CLUSTER_RESIDUAL_M),
    )
    rows = n + np.searchsorted(frames, gap)
    place = np.einsum("tab,tb->ta", turn[rows], told[rows] + course[wanted]) + centre[rows]
    return place, np.sqrt(variance[wanted] + CLUSTER_SAMPLE_NOISE_M**2)


def align_cluster(cluster: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> a cluster (T, K, 3) in its own axes, and these axes: turn (T, 3, 3) and centre (T, 3) in the world."""
    weights = np.broadcast_to(weight, cluster.shape[:2])
    shape = cluster[0] - weight @ cluster[0] / weight.sum()
    for _ in range(2):
        cross, centre, _ = compute_cross_covariance(cluster, shape, weights)
        turn = fit_rotations(cross)
        own = transform_to_body_axes(cluster, centre, turn)
        shape = own.mean(0)
    return own, turn, centre


def regress_positions(shape: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, float]:
    """-> expected places (T, 3) by a ridge regression on `shape` (T, F) learnt from its first rows, those of `own` (N, 3).

    And the root mean square of what it misses per axis where it has not learnt, in metres.
    """
    n, size = len(own), shape.shape[1]
    mean, centre = shape[:n].mean(0), own.mean(0)
    x, y = shape - mean, own - centre
    square, moment = x[:n].T @ x[:n], x[:n].T @ y

    def gain(fold: np.ndarray) -> np.ndarray:  # learnt without it
        a, b = x[fold], y[fold]
        return np.linalg.solve(square - a.T @ a + (n - len(a)) * SHAPE_RIDGE_M**2 * np.eye(size), moment - a.T @ b)

    missed = np.concatenate([y[fold] - x[fold] @ gain(fold) for fold in np.array_split(np.arange(n), CROSS_VALIDATION_FOLDS)])
    return centre + x @ gain(np.arange(0)), float(np.sqrt((missed**2).mean()))

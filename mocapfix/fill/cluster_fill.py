"""Filling from the markers that move with the missing one: those on the same head, forearm, plate or prop, and its neighbours.

Two markers on one rigid body keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"). Each gap is filled from the markers with the most constant distances that
are visible throughout. They define axes by weighted registration. A regression learned from the take predicts the position of the
missing marker in these axes from the deformation of the cluster (a joint in between, skin). The residual at the edges of the gap
is interpolated. A rigid cluster is therefore exact, and the accuracy of a loose one is that of its past.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.stats.gaussian_process import interpolate_residual
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations, transform_to_body_axes
from mocapfix.stats.sequences import find_runs, sample_evenly

MAX_DISTANCE_CHANGE_M = 0.1  # variation of the distance of two markers above which one does not predict the other
MIN_DISTANCE_CHANGE_M = 0.003  # variation of a distance on one rigid body, which bounds the weight of a marker
MIN_CLUSTER_MARKERS = 3  # markers that define axes
MAX_CLUSTER_MARKERS = 12  # markers that predict one position
MIN_CLUSTER_FRAMES = 30  # frames in which the missing marker and its cluster must be visible
MAX_CLUSTER_TRAINING_FRAMES = 300  # evenly spaced frames from which distances and deformations are learned
SHAPE_RIDGE_M = 0.01  # ridge of the regression: deformations far below it are ignored
INDEPENDENT_FRAME_S = 0.5
"""Time after which another frame shows an independent deformation: frames in between do not make the regression more certain."""
CROSS_VALIDATION_FOLDS = 4  # stretches of the take, each predicted from the others, that give the error of the regression
CLUSTER_RESIDUAL_FADE_S = 0.3  # time scale of the correlation of the residual
CLUSTER_RESIDUAL_REACH_S = 0.1  # time on either side of a gap that is used
MIN_CLUSTER_RESIDUAL_M = 0.001  # smallest standard deviation of the residual


class AlignedCluster(NamedTuple):
    """A cluster in its own axes (T, K, 3), and these axes in the world: rotation (T, 3, 3) and centre (T, 3) m."""

    markers: np.ndarray
    rotation: np.ndarray
    centre: np.ndarray


def fill_from_clusters(
    markers: Float[np.ndarray, "T M 3"], rate: float
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]]:
    """Return positions of missing samples in metres, and their standard deviations per axis; NaN elsewhere.

    A gap through which fewer than three suitable markers are visible is not filled.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    visible = ~np.isnan(markers[..., 0])
    filled, sd = np.full(markers.shape, np.nan), np.full(visible.shape, np.nan)
    if visible.all() or not visible.any():
        return filled, sd
    change = compute_distance_changes(markers)
    for m in np.flatnonzero(~visible.all(0) & visible.any(0)):
        nearest = np.argsort(change[m], kind="stable")
        nearest = nearest[change[m, nearest] < MAX_DISTANCE_CHANGE_M]
        for first, last in find_runs(~visible[:, m]):
            cluster = nearest[visible[first : last + 1, nearest].all(0)][:MAX_CLUSTER_MARKERS]
            training = np.flatnonzero(visible[:, m] & visible[:, cluster].all(1))
            if len(cluster) >= MIN_CLUSTER_MARKERS and len(training) >= MIN_CLUSTER_FRAMES:
                weight = 1 / (change[m, cluster] ** 2 + MIN_DISTANCE_CHANGE_M**2)
                training = training[sample_evenly(len(training), MAX_CLUSTER_TRAINING_FRAMES)]
                gap = slice(first, last + 1)
                filled[gap, m], sd[gap, m] = fill_gap_from_cluster(
                    markers, int(m), cluster, weight, training, gap=(first, last), rate=rate
                )
    return filled, sd


def compute_distance_changes(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "M M"]:
    """Return the variation of the distance of each pair of markers in metres, robustly; infinite where unknown."""
    sampled = markers[sample_evenly(len(markers), MAX_CLUSTER_TRAINING_FRAMES)]
    enough = np.flatnonzero((~np.isnan(sampled[..., 0])).sum(0) >= min(MIN_CLUSTER_FRAMES, len(sampled) // 10 + 2))
    change = np.full((markers.shape[1],) * 2, np.inf)
    for n, i in enumerate(enough[1:], start=1):
        distance = np.sort(np.linalg.norm(sampled[:, i, None] - sampled[:, enough[:n]], axis=-1), axis=0)  # NaN comes last
        low, high = (compute_column_percentiles(distance, share) for share in (0.16, 0.84))
        is_known = np.isfinite(high)
        others = enough[:n][is_known]
        # half this range is the standard deviation of a normal distribution
        change[i, others] = change[others, i] = (high[is_known] - low[is_known]) / 2
    return change


def compute_column_percentiles(ordered: Float[np.ndarray, "T N"], share: float) -> Float[np.ndarray, " N"]:
    """Return the quantile `share` of each column, which must ascend and end with its NaN; infinite for fewer than two values."""
    count = (~np.isnan(ordered)).sum(0)
    last, columns = np.maximum(count - 1, 0), np.arange(ordered.shape[1])
    position = share * last
    below = position.astype(int)
    above = np.minimum(below + 1, last)
    quantile = ordered[below, columns] + (position - below) * (ordered[above, columns] - ordered[below, columns])
    return np.where(count >= 2, quantile, np.inf)


def fill_gap_from_cluster(
    markers: Float[np.ndarray, "T M 3"],
    marker: int,
    cluster_markers: Int[np.ndarray, " K"],
    weight: Float[np.ndarray, " K"],
    training_frames: Int[np.ndarray, " N"],
    *,
    gap: tuple[int, int],
    rate: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return the positions of a marker over the frames first..last of a gap in metres, and the standard deviation per axis.

    cluster_markers  the markers that predict it, with their weights
    training_frames  frames in which all of them are visible
    """
    first, last = gap
    reach = max(1, round(CLUSTER_RESIDUAL_REACH_S * rate))
    frames = np.arange(max(0, first - reach), min(len(markers), last + 1 + reach))
    frames = frames[~np.isnan(markers[np.ix_(frames, cluster_markers)][..., 0]).any(1)]
    n, rows = len(training_frames), np.r_[training_frames, frames]
    cluster = align_cluster(markers[np.ix_(rows, cluster_markers)], weight)
    measured = transform_to_body_axes(markers[rows, marker][:, None], cluster.centre, cluster.rotation)[:, 0]
    independent_count = len(np.unique((training_frames / (rate * INDEPENDENT_FRAME_S)).astype(int)))
    predicted, error, inflation = regress_positions(cluster.markers.reshape(len(rows), -1), measured[:n], n / independent_count)
    residual = np.full((frames[-1] - frames[0] + 1, 3), np.nan)  # the frames beside a gap need not be consecutive
    residual[frames - frames[0]] = (measured - predicted)[n:]
    gap_frames = np.arange(first, last + 1)
    is_gap = np.zeros(len(residual), bool)
    is_gap[gap_frames - frames[0]] = True
    interpolated, variance, _ = interpolate_residual(
        residual,
        is_gap,
        rate,
        time_scale_s=CLUSTER_RESIDUAL_FADE_S,
        margin_s=CLUSTER_RESIDUAL_REACH_S,
        noise_sd=SAMPLE_NOISE_M,
        min_sd=max(error, MIN_CLUSTER_RESIDUAL_M),
    )
    rows = n + np.searchsorted(frames, gap_frames)
    local = predicted[rows] + interpolated[is_gap]
    positions = np.einsum("tab,tb->ta", cluster.rotation[rows], local) + cluster.centre[rows]
    return positions, np.sqrt(variance[is_gap] * inflation[rows] ** 2 + SAMPLE_NOISE_M**2)


def align_cluster(cluster: Float[np.ndarray, "T K 3"], weight: Float[np.ndarray, " K"]) -> AlignedCluster:
    """Return a cluster in axes that follow its mean shape."""
    weights = np.broadcast_to(weight, cluster.shape[:2])
    shape = cluster[0] - weight @ cluster[0] / weight.sum()
    for _ in range(2):
        cross, centre, _ = compute_cross_covariance(cluster, shape, weights)
        rotation = fit_rotations(cross)
        local = transform_to_body_axes(cluster, centre, rotation)
        shape = local.mean(0)
    return AlignedCluster(local, rotation, centre)  # pyright: ignore[reportPossiblyUnboundVariable]  # the loop runs twice


def regress_positions(
    deformation: Float[np.ndarray, "T F"], measured: Float[np.ndarray, "N 3"], frames_per_independent: float
) -> tuple[Float[np.ndarray, "T 3"], float, Float[np.ndarray, " T"]]:
    """Return positions in metres predicted by a ridge regression, its cross-validated error per axis, and its inflation (T,).

    The error holds for deformations like those of the folds. One that differs more from what was learned has a larger variance:
    that of the regression's coefficients, x' (X'X + ridge)^-1 x, counts in addition.

    deformation             positions of the cluster's markers; the first N rows are those of the measured positions
    frames_per_independent  number of learned frames of which one is independent of the others
    """
    n, size = len(measured), deformation.shape[1]
    mean, centre = deformation[:n].mean(0), measured.mean(0)
    x, y = deformation - mean, measured - centre
    square, moment = x[:n].T @ x[:n], x[:n].T @ y

    def fit_without(fold: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the predictions and the leverages of some rows from a fit without a fold."""
        a, b = x[fold], y[fold]
        curvature = square - a.T @ a + (n - len(a)) * SHAPE_RIDGE_M**2 * np.eye(size)
        solved = np.linalg.solve(curvature, np.concatenate([moment - a.T @ b, targets.T], axis=1))
        return targets @ solved[:, :3], np.einsum("nf,fn->n", targets, solved[:, 3:])

    folds = np.array_split(np.arange(n), CROSS_VALIDATION_FOLDS)
    validated = [fit_without(fold, x[fold]) for fold in folds]
    errors = y - np.concatenate([predicted for predicted, _ in validated])
    usual_leverage = float(np.mean(np.concatenate([leverage for _, leverage in validated])))
    predicted, leverage = fit_without(np.arange(0), x)
    variance_ratio = (1 + frames_per_independent * leverage) / (1 + frames_per_independent * usual_leverage)
    return centre + predicted, float(np.sqrt((errors**2).mean())), np.sqrt(np.maximum(variance_ratio, 1.0))

"""Calibration uncertainty: how far bones and markers of a calibrated subject may lie from the true ones.

A calibration error is the same in every frame, so that no residual shows it. It is predicted from the normal equations of the
calibration, with the actual variation of markers about their places instead of the weights of the fit.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.stats.gaussian_process import evaluate_matern
from mocapfix.stats.residual_process import CHI2_MEDIAN_3_DOF

SKIN_CORRELATION_S = 0.3
"""Time after which the correlation of a marker's motion with the skin has fallen to 1/e."""
MIN_SKIN_SD_M = 0.001
"""Smallest estimate of the residual's standard deviation."""
MAX_POSE_ABSORBED_SHARE = 0.8
"""Largest share of the markers' error that the poses are assumed to absorb."""


def estimate_residual_sd(distance: Float[np.ndarray, "N K"], pose_freedom: int) -> float:
    """Return the standard deviation per axis, in metres, of a marker about its place on the calibrated body.

    Each frame's pose has absorbed a part of the markers' motion. The estimate is larger than the residuals accordingly.

    distance      of each marker to the body, in metres, NaN if not visible
    pose_freedom  number of coordinates of a pose that the markers determine
    """
    measured = 3 * np.isfinite(distance).sum(1).mean()
    share = min(pose_freedom / max(measured, 1.0), MAX_POSE_ABSORBED_SHARE)
    return max(float(np.sqrt(np.nanmedian(distance**2) / CHI2_MEDIAN_3_DOF / (1 - share))), MIN_SKIN_SD_M)


def compute_shared_covariance(
    marker_response: Float[np.ndarray, "n rows K 3"],
    marker_weight: Float[np.ndarray, "n K"],
    curvature: Float[np.ndarray, "Q Q"],
    prior_gradient_covariance: Float[np.ndarray, "Q Q"],
    times_s: Float[np.ndarray, " N"],
    residual_sd_m: float,
) -> Float[np.ndarray, "Q Q"]:
    """Return the covariance of the errors of the shared unknowns.

    The curvature weights every frame as if it were measured independently, with the marker error of the fit. Actually markers
    slide with the skin, by less, but for a part of a second, so that neighbouring frames have nearly the same error. The
    covariance of an estimate with these weights is H^-1 G H^-1, H the curvature and G the actual covariance of the gradient
    (Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions").

    marker_response, marker_weight  of n of the N frames, each of which stands for an equal part of them (see `SharedResponses`)
    prior_gradient_covariance       of the gradient of the prior's cost: the prior's part of the curvature, larger for unknowns
                                    that vary more than the fit assumes
    times_s                         of all frames, in rising order
    residual_sd_m                   of a marker about its place on the body, per axis
    """
    correlation = evaluate_matern(np.abs(times_s[:, None] - times_s) / SKIN_CORRELATION_S, 1)
    parts = np.linspace(0, len(times_s), len(marker_weight) + 1).astype(int)[:-1]
    summed = np.add.reduceat(np.add.reduceat(correlation, parts, axis=0), parts, axis=1)
    weighted = marker_response[:, :-1] * marker_weight[:, None, :, None]
    smoothed = (summed @ weighted.reshape(len(weighted), -1)).reshape(weighted.shape)
    marker_gradient_covariance = residual_sd_m**2 * np.tensordot(smoothed, weighted, axes=([0, 2, 3], [0, 2, 3]))
    gradient_covariance = marker_gradient_covariance + prior_gradient_covariance
    covariance = np.linalg.solve(curvature, np.linalg.solve(curvature, gradient_covariance).T)
    return (covariance + covariance.T) / 2


def compute_response_sd(
    joint_response: Float[np.ndarray, "n Q J 3"],
    marker_response: Float[np.ndarray, "n rows K 3"],
    covariance: Float[np.ndarray, "Q Q"],
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " K"]]:
    """Return the root mean square per axis, in metres, of the motion of joints and markers with uncertain shared unknowns.

    covariance  of the shared unknowns
    """
    half = np.linalg.cholesky(covariance).T  # half.T @ half is the covariance
    displacements = (half @ response.reshape(*response.shape[:2], -1) for response in (joint_response, marker_response[:, :-1]))
    joint_sd, marker_sd = (np.sqrt((d**2).sum(1).mean(0).reshape(-1, 3).mean(1)) for d in displacements)
    return joint_sd, marker_sd

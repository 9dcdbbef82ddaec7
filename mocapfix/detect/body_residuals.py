"""Residuals of the samples from the solved body's markers, and their expected size.

A residual is measured in the segment's axes, and from the marker's usual position there, so that neither motion nor a bias
of the calibration counts. The residuals of a sound sample are as large as the marker's usually are, and larger where the
solver predicts a larger uncertainty of the marker than usual. (A marker attracts the body, which makes its residuals
smaller, so each marker is compared with itself.) In standard deviations one threshold holds for all markers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

# Smallest standard deviation of a residual per axis, even for a marker whose errors the body follows.
MIN_RESIDUAL_SD_M = 0.003
# Median of a chi-squared distribution with three degrees of freedom.
CHI_SQUARED_3_MEDIAN = 2.366


class BodyResiduals(NamedTuple):
    """The residuals of K markers over T frames.

    Attributes:
        measured_world: Measured positions (T, K, 3) in metres, NaN where missing.
        expected_world: Usual positions (T, K, 3) in metres of the markers on the solved body, never NaN.
        residual_segment: Vectors (T, K, 3) in metres from the expected to the measured positions, in the segment's axes, NaN
            where missing.
        sd_m: Standard deviation (T, K) in metres per axis of the residual of a sound sample, never NaN.
    """

    measured_world: np.ndarray
    expected_world: np.ndarray
    residual_segment: np.ndarray
    sd_m: np.ndarray

    @property
    def distance_m(self) -> Float[np.ndarray, "T K"]:
        """The lengths of the residuals in metres, NaN where missing."""
        return np.linalg.norm(self.residual_segment, axis=-1)


def compute_body_residuals(
    subject_take: Take, solver_mask: Bool[np.ndarray, "T K"], subject: Subject, motion: Motion
) -> BodyResiduals:
    """Compute the residuals of a subject's markers from the solved body.

    Args:
        subject_take: The take's markers in the subject's order.
        solver_mask: The samples that the solve used.
        subject: The subject.
        motion: The solved motion.
    """
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    position, rotation = position[:, subject.joints], rotation[:, subject.joints]
    residual = np.einsum("tkba,tkb->tka", rotation, subject_take.markers - position) - subject.marker_offsets
    bias, sd_m = np.zeros((residual.shape[1], 3)), np.full(residual.shape[1], MIN_RESIDUAL_SD_M)
    for k in np.flatnonzero(solver_mask.any(0)):
        bias[k] = np.median(residual[solver_mask[:, k], k], axis=0)
        square = ((residual[solver_mask[:, k], k] - bias[k]) ** 2).sum(1)
        sd_m[k] = max(MIN_RESIDUAL_SD_M, np.sqrt(np.median(square) / CHI_SQUARED_3_MEDIAN))
    expected_world = position + np.einsum("tkab,kb->tka", rotation, subject.marker_offsets + bias)
    excess_variance = np.maximum(motion.marker_sd**2 - np.median(motion.marker_sd, axis=0) ** 2, 0)
    return BodyResiduals(subject_take.markers, expected_world, residual - bias, np.sqrt(sd_m**2 + excess_variance))

"""How far each sample lies off the place where the solved body has its marker, and how far it may.

Measured in the segment's axes and from the marker's usual place, so that neither motion nor a bias of the calibration
counts. A sound sample's distance is as large as the marker's own distances usually are, and larger where the solver
foretells that the body is less sure of the marker than usual (a marker pulls the body to itself, and its distances are
the smaller for it: so each is held against its own). In standard deviations one threshold serves all markers.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

MIN_RESIDUAL_SD_M = 0.003  # metres per axis: no marker keeps its place better, whatever the body takes up of its errors
CHI_SQUARED_3_MEDIAN = 2.366  # the median of a chi-squared of three degrees of freedom


class BodyResiduals(NamedTuple):
    """Of T frames of K markers, NaN where not seen:

    measured  (T, K, 3) metres: the samples
    usual     (T, K, 3) metres: where the marker usually is when the body is so; never NaN
    path      (T, K, 3) metres: from there to the sample, in the segment's axes
    sd        (T, K) metres per axis: how far a sound sample may be from there; never NaN
    """

    measured_world: np.ndarray
    expected_world: np.ndarray
    residual_segment: np.ndarray
    sd_m: np.ndarray

    @property
    def distance_m(self) -> np.ndarray:
        """(T, K) metres."""
        return np.linalg.norm(self.residual_segment, axis=-1)


def compute_body_residuals(subject_take: Take, solver_mask: np.ndarray, subject: Subject, motion: Motion) -> BodyResiduals:
    """-> how far the samples of the subject's markers are off the body that listened to those `heard` (T, K)."""
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    position, rotation = position[:, subject.joints], rotation[:, subject.joints]
    path = np.einsum("tkba,tkb->tka", rotation, subject_take.markers - position) - subject.marker_offsets
    bias, spread = np.zeros((path.shape[1], 3)), np.full(path.shape[1], MIN_RESIDUAL_SD_M)
    for k in np.flatnonzero(solver_mask.any(0)):
        bias[k] = np.median(path[solver_mask[:, k], k], axis=0)
        square = ((path[solver_mask[:, k], k] - bias[k]) ** 2).sum(1)
        spread[k] = max(MIN_RESIDUAL_SD_M, np.sqrt(np.median(square) / CHI_SQUARED_3_MEDIAN))
    usual = position + np.einsum("tkab,kb->tka", rotation, subject.marker_offsets + bias)
    unsure = np.maximum(motion.marker_sd**2 - np.median(motion.marker_sd, axis=0) ** 2, 0)
    return BodyResiduals(subject_take.markers, usual, path - bias, np.sqrt(spread**2 + unsure))

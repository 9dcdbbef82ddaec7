"""The combination of a gap's prediction by the motion prior with another estimate of the same joints.

They are weighted by their precisions. Their errors are correlated, because both continue the motion on either side; so the
variance decreases less than for independent estimates.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

MOTION_VARIANCE_FACTOR = 2.0
"""Factor of the predicted variance in the weight: new people and captures differ from the training data."""
PREDICTION_CORRELATION = 0.4
"""Correlation of the errors of the prediction with those of other estimates."""
CROPPED_CONTEXT_S = 1.1
"""Time on either side of a gap that a prediction is given; more than the network uses."""


class GapPrediction(NamedTuple):
    """The motion prior's prediction of L joints in n frames.

    rotations      (n, L, 3, 3) local;  variance       (n, L) rad^2 per axis, infinite for joints that it does not predict
    root_position  (n, 3) m;            root_variance  (n,) m^2 per axis
    """

    rotations: np.ndarray
    variance: np.ndarray
    root_position: np.ndarray
    root_variance: np.ndarray

    def select_joints(self, joints: Int[np.ndarray, " N"]) -> "GapPrediction":
        """Return the prediction of some of the joints."""
        return self._replace(rotations=self.rotations[:, joints], variance=self.variance[:, joints])


class GapContext(NamedTuple):
    """The motion around a gap: root (T, 3) m, local rotations (T, J, 3, 3) and what is known (T, J) of a body's joints.

    The missing rotations hold other estimates. The gap has the frames first..last, inclusive.
    """

    root_position: np.ndarray
    local_rotations: np.ndarray
    is_known: np.ndarray
    first: int
    last: int
    rate_hz: float

    def crop(self) -> "GapContext":
        """Return the frames that the network needs."""
        margin = int(np.ceil(CROPPED_CONTEXT_S * self.rate_hz))
        start = max(0, self.first - margin)
        frames = slice(start, self.last + 1 + margin)
        parts = self.root_position[frames], self.local_rotations[frames], self.is_known[frames]
        return GapContext(*parts, self.first - start, self.last - start, self.rate_hz)

    @property
    def frames(self) -> slice:
        """The frames of the gap."""
        return slice(self.first, self.last + 1)


def combine_rotations(
    rotations: Float[np.ndarray, "n L 3 3"],
    variance: Float[np.ndarray, "n L"],
    prediction: GapPrediction,
) -> tuple[Float[np.ndarray, "n L 3 3"], Float[np.ndarray, "n L"]]:
    """Return an estimate of rotations combined with the prediction of the same joints, and its variance in rad^2."""
    weight = compute_prediction_weight(variance, prediction.variance)
    difference = np.swapaxes(rotations, -1, -2) @ prediction.rotations
    vectors = Rotation.from_matrix(difference.reshape(-1, 3, 3)).as_rotvec().reshape(*weight.shape, 3)
    turn = Rotation.from_rotvec((weight[..., None] * vectors).reshape(-1, 3)).as_matrix().reshape(rotations.shape)
    return rotations @ turn, compute_combined_variance(variance, prediction.variance, weight)


def compute_prediction_weight(
    variance: Float[np.ndarray, "*shape"], predicted_variance: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the weight of the prediction against an estimate; zero where the prediction's variance is infinite."""
    total = variance + MOTION_VARIANCE_FACTOR * predicted_variance
    return np.divide(variance, total, out=np.zeros_like(variance), where=(total > 0) & np.isfinite(total))


def compute_combined_variance(
    variance: Float[np.ndarray, "*shape"], predicted_variance: Float[np.ndarray, "*shape"], weight: Float[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Return the variance of the weighted mean of two estimates with correlated errors."""
    finite = np.where(np.isfinite(predicted_variance), predicted_variance, 0.0)
    shared = 2 * PREDICTION_CORRELATION * weight * (1 - weight) * np.sqrt(variance * finite)
    return (1 - weight) ** 2 * variance + weight**2 * finite + shared

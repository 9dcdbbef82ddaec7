"""Uncertainty of the solved motion: the posterior covariance of the poses, computed from the root to the leaves.

The solver weights its terms for robustness: it assumes a large marker error, and applies the prior only once in a while, since
neighbouring frames are correlated. The error of its result is a different question. It is computed from the same curvature and
factorisation, with the actual uncertainty of each term:

- markers: estimated from their distances to the solved body, corrected for the part of the error that the poses absorbed, as in
  the a posteriori variance of least squares;
- the pose prior: applied in every frame, since it constrains one frame's pose no less if it is applied to its neighbours too
  (joint limits stay as in the solve; inside them they have no effect);
- joints that lost a marker: the variance of their interpolated trajectory at this distance from the edge of the gap;
- the calibration error, which no frame shows: taken from the subject.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.kernels.terms import TrackingTerm
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.solve import kinematics
from mocapfix.solve.pose_problem import PoseProblem, build_pose_prior_term
from mocapfix.subject import CALIBRATION_SD_RATIO, Subject

MIN_ESTIMATED_MARKER_SD_M = 0.001
"""Smallest estimate of the marker error per axis."""
CHI2_MEDIAN_3_DOF = 2.366
"""Median of the chi-squared distribution with three degrees of freedom."""
MAX_ABSORBED_SHARE = 0.9
"""Share of its squared error that the pose absorbs above which a marker does not enter the estimate."""


def compute_pose_sd(
    problem: PoseProblem,
    motion: Motion,
    subject: Subject,
    prior: MeanPosePrior,
    nominal_marker_sd: Float[np.ndarray, "T K"],
    tracking: TrackingTerm,
    robust_scale_m: float,
) -> tuple[Float[np.ndarray, "T K"], Float[np.ndarray, "T J"]]:
    """Return the standard deviations per axis, in metres, of the markers as the body places them, and of the joints.

    problem            as it was solved
    nominal_marker_sd  standard deviation of the markers predicted with the weights of the solve, in metres
    tracking           the trajectories of the root and of joints that lack a marker, weighted by their actual uncertainty
    robust_scale_m     the last robust scale of the solve
    """
    _, predicted = kinematics.compute_joint_and_marker_positions(subject, motion)
    absorbed_share = (nominal_marker_sd / problem.marker_sd) ** 2
    distance = np.linalg.norm(problem.marker_positions - predicted, axis=-1)
    is_usable = problem.solver_mask & (absorbed_share < MAX_ABSORBED_SHARE)
    marker_sd = estimate_marker_sd(distance, absorbed_share, is_usable, problem.marker_sd)
    actual = replace(problem, marker_sd=marker_sd, pose_prior=build_pose_prior_term(prior))
    uncertainty = actual.compute_uncertainty(motion.root_position, motion.local_rotations, tracking, robust_scale_m)
    return (
        np.hypot(uncertainty.marker_sd, CALIBRATION_SD_RATIO * subject.marker_sd),
        np.hypot(uncertainty.joint_sd, CALIBRATION_SD_RATIO * subject.joint_sd),
    )


def estimate_marker_sd(
    distance: Float[np.ndarray, "T K"],
    absorbed_share: Float[np.ndarray, "T K"],
    is_usable: Bool[np.ndarray, "T K"],
    default_sd: float,
) -> float:
    """Return the error of markers in metres per axis, from their distances to the body that was fitted to them.

    absorbed_share  part of a marker's squared error that the pose absorbed: 0 none, 1 all
    is_usable       samples that enter the estimate; without any, `default_sd` is returned
    """
    if not is_usable.any():
        return default_sd
    corrected = distance[is_usable] ** 2 / (1 - absorbed_share[is_usable])
    return max(float(np.sqrt(np.median(corrected) / CHI2_MEDIAN_3_DOF)), MIN_ESTIMATED_MARKER_SD_M)

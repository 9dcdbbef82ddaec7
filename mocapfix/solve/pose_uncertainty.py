"""How far the solved joints and markers lie from the truth: the posterior covariance of the poses, root to leaves.

The solve weighs its terms so that it withstands what may be wrong with a take: it takes a marker to lie 10 mm from its place,
and asks people's habits once in a while, for a take's frames are alike. How wrong its result is, is another question. It
is asked anew, of the same curvature and factorisation, with each term as uncertain as it really is:

- markers, as the distances show that they keep from the solved body: what the poses took up of them is made good for, as
  in the a posteriori variance of least squares;
- people's poses, in every frame: of one frame's pose they say no less for being said of its neighbours, too (limits
  stay as the solve has them: between their walls they say nothing);
- joints that lost a marker, by how far their course can be known that long after a gap's edge;
- calibration's own error, which no frame tells and the subject carries, beside all that.
"""

from dataclasses import replace

import numpy as np

from mocapfix.kernels.terms import TrackingTerm
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.solve import kinematics
from mocapfix.solve.pose_problem import PoseProblem, build_pose_prior_term
from mocapfix.subject import Subject

MIN_ESTIMATED_MARKER_SD_M = 0.001  # metres: no marker keeps its place better
CHI2_MEDIAN_3_DOF = 2.366  # the median of a chi-squared of three degrees of freedom
MAX_ABSORBED_SHARE = 0.9  # a marker whose error the pose takes up almost whole tells nothing of its size
CALIBRATION_SD_RATIO = (
    0.75  # of the calibration's own deviation: people's marker places and bones stray less from the average than it allows
)


def compute_pose_sd(
    problem: PoseProblem,
    motion: Motion,
    subject: Subject,
    prior: MeanPosePrior,
    nominal_marker_sd: np.ndarray,
    tracking: TrackingTerm,
    robust_scale_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """-> standard deviations per axis, metres, of the markers (T, K) as the body places them and of the joints (T, J).

    problem  as it was solved
    alone    (T, K) metres: the deviation of the markers that its own weights foretold
    time     what the moments around say of the joints that miss a marker and of the root, as surely as they do
    robust   metres: the scale beyond which the solve no longer believed a marker
    """
    _, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    taken_up = (nominal_marker_sd / problem.marker_sd) ** 2
    distance = np.linalg.norm(problem.marker_positions - markers, axis=-1)
    marker_sd = estimate_marker_sd(distance, taken_up, problem.solver_mask & (taken_up < MAX_ABSORBED_SHARE), problem.marker_sd)
    honest = replace(problem, marker_sd=marker_sd, pose_prior=build_pose_prior_term(prior))
    posed = honest.compute_uncertainty(motion.root_position, motion.local_rotations, tracking, robust_scale_m)
    return np.hypot(posed.marker_sd, CALIBRATION_SD_RATIO * subject.marker_sd), np.hypot(
        posed.joint_sd, CALIBRATION_SD_RATIO * subject.joint_sd
    )


def estimate_marker_sd(distance: np.ndarray, absorbed_share: np.ndarray, is_usable: np.ndarray, default_sd: float) -> float:
    """-> metres per axis: by how much markers stray from their places, from their distances (T, K) to the body fitted to them.

    taken_up  (T, K) the part of a marker's error, squared, that the pose took up: 0 none, 1 all
    tell      (T, K) bool: the samples that are asked; where there are none, the answer is `otherwise`
    """
    if not is_usable.any():
        return default_sd
    return max(
        float(np.sqrt(np.median(distance[is_usable] ** 2 / (1 - absorbed_share[is_usable])) / CHI2_MEDIAN_3_DOF)),
        MIN_ESTIMATED_MARKER_SD_M,
    )

"""Observability: which marker samples the solver uses, which joints they determine, and how uncertain the solved motion is.

The uncertainty is the posterior covariance of the poses, computed from the root to the leaves. The solver weights its terms for
robustness: it assumes a large marker error, and applies the prior only once in a while, since neighbouring frames are correlated.
The error of its result is a different question. It is computed from the same curvature and factorisation, with the actual
uncertainty of each term:

- markers: estimated from their distances to the solved body, corrected for the part of the error that the poses absorbed, as in
  the a posteriori variance of least squares;
- the pose prior: applied in every frame, since it constrains one frame's pose no less if it is applied to its neighbours too
  (joint limits stay as in the solve; inside them they have no effect);
- joints that lost a marker: the variance of their interpolated trajectory at this distance from the edge of the gap;
- joints that are not solved, as in the fingers: the variation of people's poses;
- the calibration error, which no frame shows: taken from the subject.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.kernels.terms import TrackingTerm
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.pose_problem import PoseProblem, build_pose_prior_term
from mocapfix.stats.residual_process import CHI2_MEDIAN_3_DOF
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject

MIN_GAP_DURATION_S = 0.025
"""Gaps up to this duration are flicker and have no borders."""


def find_gap_borders(
    is_inlier: Bool[np.ndarray, "T K"], is_unobserved: Bool[np.ndarray, "T K"], rate: float, max_border_s: float
) -> Bool[np.ndarray, "T K"]:
    """Find the samples on either side of each marker's gaps, for up to `max_border_s` seconds, with the gaps themselves.

    The solver must not use them. A marker attracts the body, so the pose would jump where a gap begins, and the residual that is
    interpolated across the gap would be that of another pose. Samples next to a gap are also the least accurate. Flicker has no
    borders, and neither has a gap in which the marker's joint is unobserved throughout: the pose does not change there, since
    the trajectory of an unobserved joint continues from its last pose.

    is_inlier      samples that are visible and no outliers
    is_unobserved  whether the joint of the marker is unobserved
    """
    mask = np.zeros_like(is_inlier)
    for k in range(is_inlier.shape[1]):
        for first, last in find_runs(~is_inlier[:, k]):
            border = round(rate * min(max_border_s, (last - first + 1) / rate - MIN_GAP_DURATION_S))
            if border > 0 and not is_unobserved[first : last + 1, k].all():
                mask[max(0, first - border) : last + 1 + border, k] = True
    return mask


def find_partly_observed_joints(is_used: Bool[np.ndarray, "T K"], subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Find the joints that lack a marker of their own or of a child which other frames show.

    is_used  samples of the subject's markers that the solver uses
    """
    is_partly_observed = np.zeros((len(is_used), len(subject.skeleton.names)), bool)
    for k in np.flatnonzero(is_used.any(0)):
        joint = subject.joints[k]
        is_partly_observed[:, joint] |= ~is_used[:, k]
        is_partly_observed[:, max(subject.skeleton.parents[joint], 0)] |= ~is_used[:, k]
    is_partly_observed[:, 0] = False
    return is_partly_observed


def find_unobserved_joints(
    is_used: Bool[np.ndarray, "T K"], subject: Subject, free_joints: Bool[np.ndarray, " J"]
) -> Bool[np.ndarray, "T J"]:
    """Find the free joints below the root without any used marker on them or on their descendants, if other frames have one.

    is_used  samples of the subject's markers that the solver uses
    """
    is_observed = np.zeros((len(is_used), len(free_joints)), bool)
    for k, joint in enumerate(subject.joints):
        is_observed[:, joint] |= is_used[:, k]
    for j in range(len(free_joints) - 1, 0, -1):
        is_observed[:, subject.skeleton.parents[j]] |= is_observed[:, j]
    is_ever_observed = is_observed.any(0)
    return ~is_observed & free_joints & is_ever_observed & (np.arange(len(free_joints)) > 0)


MIN_ESTIMATED_MARKER_SD_M = 0.001
"""Smallest estimate of the marker error per axis."""
MAX_ABSORBED_SHARE = 0.9
"""Share of its squared error that the pose absorbs above which a marker does not enter the estimate."""


def compute_pose_sd(
    problem: PoseProblem,
    pose: Poses,
    subject: Subject,
    prior: MeanPosePrior,
    actual_marker_sd: float,
    tracking: TrackingTerm,
    robust_scale_m: float,
) -> tuple[Float[np.ndarray, "T K"], Float[np.ndarray, "T J"]]:
    """Return the standard deviations per axis, in metres, of the markers as the body places them, and of the joints.

    problem           as it was solved
    actual_marker_sd  standard deviation of a measured marker about its place, see `estimate_actual_marker_sd`, in metres
    tracking          the trajectories of the root and of joints that lack a marker, weighted by their actual uncertainty
    robust_scale_m    the last robust scale of the solve
    """
    actual = replace(problem, marker_sd=actual_marker_sd, pose_prior=build_pose_prior_term(prior))
    uncertainty = actual.compute_uncertainty(*pose, tracking, robust_scale_m)
    constant_variance = subject.joint_sd**2 + compute_unsolved_joint_variance(subject, prior, problem.tree.free)
    return np.hypot(uncertainty.marker_sd, subject.marker_sd), np.sqrt(uncertainty.joint_sd**2 + constant_variance)


def estimate_actual_marker_sd(
    problem: PoseProblem, pose: Poses, subject: Subject, nominal_marker_sd: Float[np.ndarray, "T K"]
) -> float:
    """Return the standard deviation per axis, in metres, of a measured marker about its place on the solved body.

    problem            as it was solved
    nominal_marker_sd  standard deviation of the markers predicted with the weights of the solve, in metres
    """
    predicted = kinematics.predict_markers(subject, pose)
    absorbed_share = (nominal_marker_sd / problem.marker_sd) ** 2
    distance = np.linalg.norm(problem.marker_positions - predicted, axis=-1)
    is_usable = problem.solver_mask & (absorbed_share < MAX_ABSORBED_SHARE)
    return estimate_marker_sd(distance, absorbed_share, is_usable, problem.marker_sd)


def compute_unsolved_joint_variance(
    subject: Subject, prior: MeanPosePrior, free_joints: Bool[np.ndarray, " J"]
) -> Float[np.ndarray, " J"]:
    """Return the variance per axis, in square metres, of joints whose parent rotates in people but not in the solve.

    No marker shows the rotation of a finger's base, so that it varies as in the prior. Axes about which the skeleton does not
    rotate do not count.
    """
    variance = np.zeros(len(free_joints))
    for j, parent in enumerate(subject.skeleton.parents):
        if parent < 1 or free_joints[parent]:
            continue
        rotated = np.eye(3) - np.linalg.pinv(prior.locked_information[parent]) @ prior.locked_information[parent]
        covariance = rotated @ np.linalg.inv(prior.information[parent]) @ rotated
        x, y, z = subject.skeleton.offsets[j]
        lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        variance[j] = variance[parent] + np.trace(lever @ covariance @ lever.T) / 3
    return variance


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

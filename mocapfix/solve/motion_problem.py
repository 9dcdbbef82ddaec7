"""The motion problem of a take: the pose problem of its frames, the joints that its markers leave open, and the options."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.mean_pose import JointLimits, MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import observability
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    build_joint_limit_term,
    build_pose_prior_term,
)
from mocapfix.subject import Subject
from mocapfix.take import Take

PRIOR_HUBER_SCALE_SD = 1.0
"""Deviation of a joint from the mean pose, in standard deviations, beyond which the prior's force no longer grows: a forearm that
follows its markers may then turn across the elbow's hinge, as skin and a wrong marker offset make it appear to."""


@dataclass(frozen=True)
class PoseEvidence:
    """What is known of T solved frames besides their poses, with the weights of the solve. Windows are written into the arrays.

    marker_sd          (T, K) m: standard deviation per axis of each marker as the frame's own solution places it
    rotation_variance  (T, J) rad^2: of each joint in the frame's own solution
    gap_variance       (T, J) rad^2: of the interpolated rotations of joints that lack a marker
    root_weight        (T,) 1/m^2: of the root's smooth trajectory
    """

    marker_sd: Float[np.ndarray, "T K"]
    rotation_variance: Float[np.ndarray, "T J"]
    gap_variance: Float[np.ndarray, "T J"]
    root_weight: Float[np.ndarray, " T"]

    def copy(self, marker_count: int) -> "PoseEvidence":
        """Return a copy for a number of markers; markers that were not solved for have a deviation of 0."""
        marker_sd = np.zeros((len(self.marker_sd), marker_count))
        count = min(marker_count, self.marker_sd.shape[1])
        marker_sd[:, :count] = self.marker_sd[:, :count]
        return PoseEvidence(marker_sd, self.rotation_variance.copy(), self.gap_variance.copy(), self.root_weight.copy())


@dataclass(frozen=True)
class MotionProblem:
    """The problem of T consecutive frames.

    pose_problem   of the frames
    subject        with the K markers
    prior          the mean pose of independent joints, which makes every frame determinate
    is_unobserved  (T, J) joints that no marker shows
    is_uncertain   (T, J) joints that lack a marker, or all
    rate           frames per second
    """

    pose_problem: PoseProblem
    subject: Subject
    prior: MeanPosePrior
    is_unobserved: Bool[np.ndarray, "T J"]
    is_uncertain: Bool[np.ndarray, "T J"]
    rate: float
    options: SolveOptions

    def select_frames(self, frames: slice) -> "MotionProblem":
        """Return the problem of some frames."""
        return MotionProblem(
            self.pose_problem.select_frames(frames),
            self.subject,
            self.prior,
            self.is_unobserved[frames],
            self.is_uncertain[frames],
            self.rate,
            self.options,
        )


def build_motion_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> MotionProblem:
    """Return the problem of a take whose markers are in the subject's order, NaN where missing or rejected."""
    problem = build_pose_problem(take, subject, body, prior, limits, options)
    is_unobserved = observability.find_unobserved_joints(problem.solver_mask, subject, body.free_joints)
    is_partly_observed = observability.find_partly_observed_joints(problem.solver_mask, subject)
    is_uncertain = (is_partly_observed | is_unobserved) & body.free_joints
    return MotionProblem(problem, subject, prior, is_unobserved, is_uncertain, take.rate, options)


def build_pose_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> PoseProblem:
    """Return the pose problem of a take: markers, prior and joint limits, with the arguments of `build_motion_problem`."""
    is_unobserved = observability.find_unobserved_joints(take.visible, subject, body.free_joints)
    is_border = observability.find_gap_borders(take.visible, is_unobserved[:, subject.joints], take.rate, options.gap_border_s)
    # neighbouring frames show the same pose, so the prior applies once in `pose_persistence_s`, not in every frame
    frames_per_pose = options.pose_persistence_s * take.rate
    return PoseProblem(
        KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, body.free_joints),
        MarkerAttachment(subject.joints, subject.marker_offsets),
        take.markers,
        take.visible & ~is_border,
        options.marker_sd_m,
        build_pose_prior_term(prior.scale_information(1 / frames_per_pose), PRIOR_HUBER_SCALE_SD),
        build_joint_limit_term(limits, options.limit_sd_rad * np.sqrt(frames_per_pose)),
    )

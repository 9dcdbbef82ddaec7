"""The pose problem of a take: a body, its measured markers, and the prior on its poses; and the motion problem, with time.

Observability: which marker samples the solver uses, and which joints they determine.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, solve_frames
from mocapfix.kernels.terms import JointLimitTerm, PointTerm, PosePriorTerm, TrackingTerm, count_rows
from mocapfix.model.motion import PoseUncertainty
from mocapfix.model.skeleton import BodyModel
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior
from mocapfix.solve.parallel import SolveOrder, order_from_gap_ends, order_independently, order_sequentially, run_over_frames
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.sequences import find_runs

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


MAX_ITERATIONS_PER_SCALE = 20  # of a frame at each robust scale
PRIOR_HUBER_SCALE_SD = 1.0
"""Deviation of a joint from the mean pose, in standard deviations, beyond which the prior's force no longer grows: a forearm that
follows its markers may then turn across the elbow's hinge, as skin and a wrong marker offset make it appear to."""


class MarkerAttachment(NamedTuple):
    """The markers' joints and their positions in the joints' axes."""

    joints: Int[np.ndarray, " K"]
    offsets: Float[np.ndarray, "K 3"]  # metres


def build_no_tracking(joints: int) -> TrackingTerm:
    """Return a tracking term of weight zero."""
    return TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1))


def build_pose_prior_term(prior: MeanPosePrior, huber_scale_sd: float = math.inf) -> PosePriorTerm:
    """Return a prior as a term of every frame; `huber_scale_sd` bounds its force on a joint, in standard deviations."""
    return PosePriorTerm(prior.mean_rotations[None], prior.information[None], huber_scale2=huber_scale_sd**2)


def build_joint_limit_term(limits: JointLimits, sd_rad: float) -> JointLimitTerm:
    """Return joint limits as soft limits: the standard deviation of an excess is `sd_rad`."""
    return JointLimitTerm(limits.mean_rotations, limits.lower_rad, limits.upper_rad, sd_rad**-2)


def build_no_joint_limits(joints: int) -> JointLimitTerm:
    """Return infinite joint limits."""
    return JointLimitTerm(np.zeros((joints, 3, 3)), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 0.0)


BodyTerms: TypeAlias = tuple[PointTerm, TrackingTerm, PosePriorTerm, JointLimitTerm]
"""the terms of a body's pose; a tuple, since the kernels are compiled for the classes in it"""


@dataclass(frozen=True)
class PoseProblem:
    """The cost of a take's poses. Poses are solved in place: root (T, 3) metres, local rotations (T, J, 3, 3).

    marker_positions  (T, K, 3) metres, the subject's markers, NaN where missing or rejected
    solver_mask       (T, K) bool: samples that the pose is fitted to; none of them NaN
    marker_sd         metres, standard deviation per axis of a marker about its place
    pose_prior        the prior of every frame about the mean pose
    """

    tree: KinematicTree
    attachment: MarkerAttachment
    marker_positions: Float[np.ndarray, "T K 3"]
    solver_mask: Bool[np.ndarray, "T K"]
    marker_sd: float
    pose_prior: PosePriorTerm
    joint_limits: JointLimitTerm

    @cached_property
    def point_term(self) -> PointTerm:
        """The markers as a term. Arrays in another order of memory would be other types and compile the solver again."""
        measured = np.ascontiguousarray(np.where(self.solver_mask[..., None], self.marker_positions, 0.0))
        weight = np.ascontiguousarray(self.solver_mask / self.marker_sd**2)
        return PointTerm(self.attachment.joints, self.attachment.offsets, measured, weight)

    def select_frames(self, frames: Int[np.ndarray, " N"] | slice) -> "PoseProblem":
        """Return the problem of some frames."""
        prior = self.pose_prior
        if len(prior.rotations) > 1:  # one for each frame, not one for all
            prior = prior._replace(rotations=prior.rotations[frames], information=prior.information[frames])
        markers, mask = self.marker_positions[frames], self.solver_mask[frames]
        return replace(self, marker_positions=markers, solver_mask=mask, pose_prior=prior)

    def build_terms(self, tracking: TrackingTerm) -> BodyTerms:
        """Return all terms of the cost, with this tracking term."""
        return self.point_term, tracking, self.pose_prior, self.joint_limits

    def normalise_robust_scales(self, scales_m: tuple[float, ...]) -> Float[np.ndarray, " S"]:
        """Return robust scales for the kernels: squared, in units of marker_sd."""
        return (np.array(scales_m) / self.marker_sd) ** 2

    def solve(
        self,
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm,
        scales_m: tuple[float, ...],
        max_iterations: int = MAX_ITERATIONS_PER_SCALE,
    ) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """Move every frame's pose to the minimum of its cost, through the robust scales. Return status and iterations.

        A frame whose root is NaN has no pose yet and starts from the solution of the frame before; all others are independent.
        """
        solve_order = order_sequentially(~np.isnan(root[:, 0]), local.shape[1])
        return self.solve_in_order(solve_order, root, local, tracking, scales_m, max_iterations)

    def solve_each(
        self,
        frames: Int[np.ndarray, " N"],
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm,
        scales_m: tuple[float, ...],
    ) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """Solve some frames, each from its own pose. Return status and iterations, 0 for the other frames."""
        solve_order = order_independently(len(frames), local.shape[1])._replace(frames=frames)
        return self.solve_in_order(solve_order, root, local, tracking, scales_m, MAX_ITERATIONS_PER_SCALE)

    def solve_from_neighbours(
        self,
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm,
        uncertain_joints: Bool[np.ndarray, "T J"],
        scale_m: float,
    ) -> None:
        """Solve the frames with uncertain joints again, each from its neighbour, from both ends of their runs inwards."""
        gaps = find_runs(np.any(uncertain_joints, axis=1))
        solve_order = order_from_gap_ends(gaps, uncertain_joints)
        self.solve_in_order(solve_order, root, local, tracking, (scale_m,), MAX_ITERATIONS_PER_SCALE)

    def solve_in_order(
        self,
        solve_order: SolveOrder,
        root: Float[np.ndarray, "T 3"],
        local: Float[np.ndarray, "T J 3 3"],
        tracking: TrackingTerm,
        scales_m: tuple[float, ...],
        max_iterations: int,
    ) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """Solve frames in an order. Return status and iterations, 0 for frames that are not in the order."""
        terms, status, iterations = self.build_terms(tracking), np.zeros(len(root), int), np.zeros(len(root), int)
        run_over_frames(
            solve_frames, len(solve_order.chain_starts) - 1, self.tree, terms, solve_order,
            self.normalise_robust_scales(scales_m), INITIAL_DAMPING_RATIO, max_iterations, count_rows(terms), root, local,
            np.zeros((len(root), 0)), status, iterations,
        )  # fmt: skip
        return status, iterations

    def compute_uncertainty(
        self, root: Float[np.ndarray, "T 3"], local: Float[np.ndarray, "T J 3 3"], tracking: TrackingTerm, scale_m: float
    ) -> PoseUncertainty:
        """Return the uncertainty of the poses at one robust scale."""
        frames, joints = local.shape[:2]
        terms = self.build_terms(tracking)
        uncertainty = PoseUncertainty(
            np.zeros(self.solver_mask.shape), np.zeros((frames, joints)), np.zeros((frames, joints)), np.zeros(frames)
        )
        run_over_frames(
            compute_uncertainty_frames, frames, self.tree, terms, self.normalise_robust_scales((scale_m,))[0],
            count_rows(terms), root, local, np.zeros((frames, 0)), *uncertainty,
        )  # fmt: skip
        return uncertainty


@dataclass(frozen=True)
class MotionProblem:
    """The problem of T consecutive frames.

    pose_problem   of the frames
    subject        with the K markers
    prior          the mean pose of independent joints, which makes every frame determinate
    is_unobserved  (T, J) joints that no marker shows
    is_uncertain   (T, J) joints that lack a marker, or all
    rate           frames per second
    conditioner    the trained prior of every frame; None: all frames have the mean pose as their prior
    """

    pose_problem: PoseProblem
    subject: Subject
    prior: MeanPosePrior
    is_unobserved: Bool[np.ndarray, "T J"]
    is_uncertain: Bool[np.ndarray, "T J"]
    rate: float
    options: SolveOptions
    conditioner: PriorConditioner | None = None

    def select_frames(self, frames: slice) -> "MotionProblem":
        """Return the problem of some frames."""
        return replace(
            self,
            pose_problem=self.pose_problem.select_frames(frames),
            is_unobserved=self.is_unobserved[frames],
            is_uncertain=self.is_uncertain[frames],
        )

    def set_pose_prior(self, pose_prior: PosePriorTerm) -> "MotionProblem":
        """Return the problem with another prior term."""
        return replace(self, pose_problem=replace(self.pose_problem, pose_prior=pose_prior))


def build_motion_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> MotionProblem:
    """Return the problem of a take whose markers are in the subject's order, NaN where missing or rejected."""
    problem = build_pose_problem(take, subject, body, prior, limits, options)
    is_unobserved = find_unobserved_joints(problem.solver_mask, subject, body.free_joints)
    is_partly_observed = find_partly_observed_joints(problem.solver_mask, subject)
    is_uncertain = (is_partly_observed | is_unobserved) & body.free_joints
    return MotionProblem(problem, subject, prior, is_unobserved, is_uncertain, take.rate, options)


def build_pose_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> PoseProblem:
    """Return the pose problem of a take: markers, prior and joint limits, with the arguments of `build_motion_problem`."""
    is_unobserved = find_unobserved_joints(take.visible, subject, body.free_joints)
    is_border = find_gap_borders(take.visible, is_unobserved[:, subject.joints], take.rate, options.gap_border_s)
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

"""The problem of a take's poses: what the solver minimises, and the frames in which it has to.

`build_pose_problem` has the terms of a body in single frames: its markers, the prior on its poses and the joint limits.
`build_motion_problem` adds time, and which joints the markers determine (`find_unobserved_joints`,
`find_partly_observed_joints`). A round of detection changes the samples of a few frames: `find_changed_frames` and
`select_windows` find these and the neighbours that smoothing connects them to. All others keep their solution. Windows also
limit the memory of a long take.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.motion import PoseUncertainty
from mocapfix.model.skeleton import BodyModel
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import terms
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior
from mocapfix.solve.minimise import PoseSolution, SolverSettings, compute_costs, compute_uncertainty, minimise
from mocapfix.solve.parallel import SolveOrder
from mocapfix.stats.sequences import find_runs, slide_windows

GAP_BORDER_S = 0.05  # time before and after its gaps for which a marker is ignored
POSE_PERSISTENCE_S = 1.0  # time in which the prior and the joint limits count once, instead of once a frame
MIN_GAP_DURATION_S = 0.025  # gaps up to this duration are flicker and have no borders


def find_gap_borders(
    is_inlier: Bool[np.ndarray, "T K"], is_unobserved: Bool[np.ndarray, "T K"], rate: float, max_border_s: float
) -> Bool[np.ndarray, "T K"]:
    """Find the samples on either side of each marker's gaps, for up to `max_border_s` seconds, with the gaps themselves.

    The solver must not use them. A marker attracts the body, so the pose would jump where a gap begins, and the residual that is
    interpolated across the gap would be that of another pose. Samples next to a gap are also the least accurate. Flicker has no
    borders, and neither has a gap in which the marker's joint is unobserved throughout: the pose does not change there, since
    the trajectory of an unobserved joint continues from its last pose.

    Args:
        is_inlier: Samples that are visible and no outliers.
    """
    mask = np.zeros_like(is_inlier)
    for k in range(is_inlier.shape[1]):
        for first, last in find_runs(~is_inlier[:, k]):
            border = round(rate * min(max_border_s, (last - first + 1) / rate - MIN_GAP_DURATION_S))
            if border > 0 and not is_unobserved[first : last + 1, k].all():
                mask[max(0, first - border) : last + 1 + border, k] = True
    return mask


def find_partly_observed_joints(is_used: Bool[np.ndarray, "T K"], subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Find the joints that lack a marker of their own or of a child which other frames show."""
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
    """Find the free joints below the root without any used marker on them or on their descendants, if other frames have one."""
    is_observed = np.zeros((len(is_used), len(free_joints)), bool)
    for k, joint in enumerate(subject.joints):
        is_observed[:, joint] |= is_used[:, k]
    for j in range(len(free_joints) - 1, 0, -1):
        is_observed[:, subject.skeleton.parents[j]] |= is_observed[:, j]
    return ~is_observed & free_joints & is_observed.any(0) & (np.arange(len(free_joints)) > 0)


MAX_ITERATIONS_PER_SCALE = 20  # of a frame at each robust scale
POSE_DAMPING_RATIO = 1e-6  # initial damping over the largest curvature; with 1e-5 weakly determined joints stop farther off
PRIOR_HUBER_SCALE_SD = 1.0
"""Deviation of a joint from the mean pose, in standard deviations, beyond which the prior's force no longer grows: a forearm that
follows its markers may then turn across the elbow's hinge, as skin and a wrong marker offset make it appear to."""


@dataclass(frozen=True)
class PoseProblem:
    """The cost of a take's poses."""

    tree: terms.KinematicTree
    attachment: terms.MarkerAttachment
    marker_positions: Float[np.ndarray, "T K 3"]  # metres, the subject's markers, NaN where missing or rejected
    solver_mask: Bool[np.ndarray, "T K"]  # bool: samples that the pose is fitted to; none of them NaN
    marker_sd: float  # metres, standard deviation per axis of a marker about its place
    pose_prior: terms.PosePriorTerm  # the prior of every frame about the mean pose
    joint_limits: terms.JointLimitTerm

    @cached_property
    def point_term(self) -> terms.PointTerm:
        return terms.build_marker_term(self.attachment, self.marker_positions, self.solver_mask, self.marker_sd)

    def select_frames(self, frames: Int[np.ndarray, " N"] | slice) -> "PoseProblem":
        return replace(self, marker_positions=self.marker_positions[frames], solver_mask=self.solver_mask[frames])

    def build_terms(self, tracking: terms.TrackingTerm | None = None) -> terms.BodyTerms:
        return self.point_term, tracking or terms.build_no_tracking(len(self.tree.parents)), self.pose_prior, self.joint_limits

    def normalise_robust_scales(self, scales_m: tuple[float, ...]) -> tuple[float, ...]:
        """Return robust scales for the kernels: squared, in units of marker_sd."""
        return tuple((scale_m / self.marker_sd) ** 2 for scale_m in scales_m)

    def minimise(
        self,
        start: Poses,
        scales_m: tuple[float, ...],
        tracking: terms.TrackingTerm | None = None,
        *,
        max_iterations: int = MAX_ITERATIONS_PER_SCALE,
        damping_ratio: float = POSE_DAMPING_RATIO,
        order: SolveOrder | None = None,
    ) -> PoseSolution:
        """Return the poses of least cost, through the robust scales. By default all frames are independent."""
        settings = SolverSettings(self.normalise_robust_scales(scales_m), max_iterations, damping_ratio, order)
        return minimise(self.tree, self.build_terms(tracking), start, settings)

    def compute_uncertainty(self, poses: Poses, scale_m: float, tracking: terms.TrackingTerm | None = None) -> PoseUncertainty:
        """Return the uncertainty of poses at one robust scale."""
        return compute_uncertainty(self.tree, self.build_terms(tracking), poses, self.normalise_robust_scales((scale_m,))[0])

    def compute_costs(self, poses: Poses, scale_m: float) -> Float[np.ndarray, " T"]:
        """Return the cost of poses at one robust scale: half the sum of squares in standard deviations."""
        return compute_costs(self.tree, self.build_terms(), poses, self.normalise_robust_scales((scale_m,))[0])


def build_marker_problem(
    subject: Subject,
    free_joints: Bool[np.ndarray, " J"],
    markers: Float[np.ndarray, "T K 3"],
    marker_sd_m: float,
    pose_prior: terms.PosePriorTerm,
    joint_limits: terms.JointLimitTerm,
) -> PoseProblem:
    """Return the pose problem of a subject and its markers, in metres, NaN where they are not used."""
    tree = terms.KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, free_joints)
    attachment = terms.MarkerAttachment(subject.joints, subject.marker_offsets)
    return PoseProblem(tree, attachment, markers, ~np.isnan(markers[..., 0]), marker_sd_m, pose_prior, joint_limits)


@dataclass(frozen=True)
class MotionProblem:
    """The problem of T consecutive frames."""

    pose_problem: PoseProblem  # of the frames
    subject: Subject  # with the K markers
    prior: MeanPosePrior  # the mean pose of independent joints, which makes every frame determinate
    is_unobserved: Bool[np.ndarray, "T J"]  # joints that no marker shows
    is_uncertain: Bool[np.ndarray, "T J"]  # joints that lack a marker, or all
    rate: float  # frames per second
    options: SolveOptions

    def select_frames(self, frames: slice) -> "MotionProblem":
        part, unobserved = self.pose_problem.select_frames(frames), self.is_unobserved[frames]
        return replace(self, pose_problem=part, is_unobserved=unobserved, is_uncertain=self.is_uncertain[frames])


def build_motion_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> MotionProblem:
    """Return the problem of a take whose markers are in the subject's order, NaN where missing or rejected."""
    problem = build_pose_problem(take, subject, body, prior, limits, options)
    is_unobserved = find_unobserved_joints(problem.solver_mask, subject, body.free_joints)
    is_uncertain = (find_partly_observed_joints(problem.solver_mask, subject) | is_unobserved) & body.free_joints
    return MotionProblem(problem, subject, prior, is_unobserved, is_uncertain, take.rate, options)


def build_pose_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> PoseProblem:
    """Return the pose problem of a take: markers, prior and joint limits, with the arguments of `build_motion_problem`."""
    is_unobserved = find_unobserved_joints(take.visible, subject, body.free_joints)
    is_border = find_gap_borders(take.visible, is_unobserved[:, subject.joints], take.rate, GAP_BORDER_S)
    # neighbouring frames show the same pose, so prior and limits count once in POSE_PERSISTENCE_S, not in every frame
    frames_per_pose = POSE_PERSISTENCE_S * take.rate
    return PoseProblem(
        terms.KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, body.free_joints),
        terms.MarkerAttachment(subject.joints, subject.marker_offsets),
        take.markers,
        take.visible & ~is_border,
        options.marker_sd_m,
        terms.build_pose_prior_term(prior.scale_information(1 / frames_per_pose), PRIOR_HUBER_SCALE_SD),
        terms.build_joint_limit_term(limits, options.limit_sd_rad * np.sqrt(frames_per_pose)),
    )


POSE_RATE_HZ = 30.0  # at which frames have first poses of their own: joints of composed takes are as near as from all frames


def list_posed_frames(frame_count: int, rate: float, pose_rate_hz: float = POSE_RATE_HZ) -> Int[np.ndarray, " N"]:
    """Return the frames that have first poses of their own: the first, the last and others between, at a rate."""
    return np.unique([*range(0, frame_count, max(1, round(rate / pose_rate_hz))), frame_count - 1])


def find_key_frames(frames: Int[np.ndarray, " N"], is_used: Bool[np.ndarray, "N K"], rate: float) -> Bool[np.ndarray, " N"]:
    """Return which frames others are interpolated from: those at POSE_RATE_HZ, and both sides of a break or a change of use."""
    has_changed = (np.diff(frames) > 1) | (is_used[1:] != is_used[:-1]).any(1)
    return (frames % max(1, round(rate / POSE_RATE_HZ)) == 0) | np.r_[True, has_changed] | np.r_[has_changed, True]


SMOOTHING_REACH_S = 0.5  # over which a frame affects others: twice the windows in which accelerations are measured
MAX_WINDOW_SHARE = 0.6  # share of the take in windows above which the whole take is solved
MAX_WINDOW_FRAMES = 8192  # frames of a window; the arrays of one hold 50 kB per frame


class FrameChanges(NamedTuple):
    """The frames of a take (T,) that must be solved again."""

    is_restarted: np.ndarray  # their samples changed, so that they start in closed form
    is_affected: np.ndarray  # their samples, markers or subject changed


class FrameWindow(NamedTuple):
    """The frames first..stop - 1, and the frames outer_first..outer_stop - 1 that are solved with them."""

    first: int
    stop: int
    outer_first: int
    outer_stop: int

    @property
    def frames(self) -> slice:
        return slice(self.first, self.stop)

    @property
    def outer_frames(self) -> slice:
        """All frames that are solved."""
        return slice(self.outer_first, self.outer_stop)

    @property
    def inner_frames(self) -> slice:
        """The frames, counted from the first that is solved."""
        return slice(self.first - self.outer_first, self.stop - self.outer_first)


def change_all_frames(frame_count: int) -> FrameChanges:
    """Return the changes of a take that was not solved before."""
    return FrameChanges(np.ones(frame_count, bool), np.ones(frame_count, bool))


def find_changed_frames(
    old_markers: Float[np.ndarray, "T K 3"], new_markers: Float[np.ndarray, "T L 3"], *, is_same_subject: bool
) -> FrameChanges:
    """Return the changes between two takes in metres, NaN where a sample is not used.

    The first markers of both are the same; the others are places of moved markers, which were fitted to the solution that has to
    be improved: their frames start from it.
    """
    count = min(old_markers.shape[1], new_markers.shape[1])
    old, new = old_markers[:, :count], new_markers[:, :count]
    is_restarted = ~((old == new) | (np.isnan(old) & np.isnan(new))).all(axis=(1, 2))
    is_extended = ~np.isnan(new_markers[:, count:]).all(axis=(1, 2))
    is_reduced = ~np.isnan(old_markers[:, count:]).all(axis=(1, 2))
    return FrameChanges(is_restarted, is_restarted | is_extended | is_reduced | (not is_same_subject))


def select_windows(is_affected: Bool[np.ndarray, " T"], rate: float) -> list[FrameWindow]:
    """Return the windows in which the frames that changes affect must be solved."""
    frame_count, reach = len(is_affected), round(SMOOTHING_REACH_S * rate)
    inner_mask = slide_windows(is_affected, 2 * reach + 1).max(1)
    if slide_windows(inner_mask, 2 * reach + 1).max(1).sum() > MAX_WINDOW_SHARE * frame_count:
        inner_mask[:] = True
    windows: list[FrameWindow] = []
    for first, last in find_runs(inner_mask):
        bounds = np.linspace(first, last + 1, -(-(last + 1 - first) // MAX_WINDOW_FRAMES) + 1).astype(int).tolist()
        windows += [FrameWindow(a, b, max(0, a - reach), min(frame_count, b + reach)) for a, b in pairwise(bounds)]
    return windows


def list_window_frames(windows: list[FrameWindow]) -> Int[np.ndarray, " N"]:
    """Return the indices of all frames of some windows."""
    return np.concatenate([np.arange(window.first, window.stop) for window in windows] or [np.zeros(0, int)])

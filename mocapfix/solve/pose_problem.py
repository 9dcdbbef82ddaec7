"""The pose problem of a whole take, bound together once: a body, what was seen of it, and what its poses are like."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, solve_frames
from mocapfix.kernels.terms import JointLimitTerm, PointTerm, PosePriorTerm, TrackingTerm, count_rows
from mocapfix.pose_prior.joint_limits import JointLimits
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.solve import frame_order
from mocapfix.solve.parallel import run_over_frames
from mocapfix.take import find_runs

SOLVER_CACHE_PATTERN = "levenberg.solve_frames-*.nbi"  # the index that Numba keeps of the longest compilation
MAX_ITERATIONS_PER_SCALE = 20  # iterations of a frame at each robust scale


class MarkerAttachment(NamedTuple):
    """The markers' places on the joints."""

    joints: np.ndarray  # (K,)
    offsets: np.ndarray  # (K, 3) metres


class PoseUncertainty(NamedTuple):
    """What the curvature at a pose leaves open, per axis."""

    marker_sd: np.ndarray  # (T, K) metres, standard deviation of each marker as the body places it
    joint_sd: np.ndarray  # (T, J) metres, standard deviation of each joint's place
    rotation_variance: np.ndarray  # (T, J) rad^2, variance of each joint's turn, [:, 0] of the root's
    root_variance: np.ndarray  # (T,) m^2, variance of the root's place


def is_solver_compiled() -> bool:
    """-> whether this machine has kept the compiled solve from an earlier run."""
    kept = solve_frames.stats.cache_path
    return kept is not None and any(Path(kept).glob(SOLVER_CACHE_PATTERN))


def build_no_tracking(joints: int) -> TrackingTerm:
    """-> a pull that pulls nothing."""
    return TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1))


def build_pose_prior_term(prior: MeanPosePrior) -> PosePriorTerm:
    """-> a prior as the pull of every frame to its mean pose."""
    return PosePriorTerm(prior.mean_rotations[None], prior.information[None])


def build_joint_limit_term(limits: JointLimits, sd: float) -> JointLimitTerm:
    """-> joint limits as soft walls; beyond them lies a standard deviation of `sd` radians."""
    return JointLimitTerm(limits.mean_rotations, limits.lower_rad, limits.upper_rad, sd**-2)


def build_no_joint_limits(joints: int) -> JointLimitTerm:
    """-> walls that no joint meets."""
    return JointLimitTerm(np.zeros((joints, 3, 3)), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 0.0)


@dataclass(frozen=True)
class PoseProblem:
    """Poses are solved in place: root (T, 3) metres, local rotations (T, J, 3, 3).

    markers    (T, K, 3) metres, the subject's markers, NaN where not believed
    listened   (T, K) bool: believed samples that the pose listens to
    marker_sd  metres, standard deviation per axis of a marker about its place
    prior      the pull of every frame to the mean pose
    limits     how far the joints turn
    """

    tree: KinematicTree
    attachment: MarkerAttachment
    marker_positions: np.ndarray
    solver_mask: np.ndarray
    marker_sd: float
    pose_prior: PosePriorTerm
    joint_limits: JointLimitTerm

    @cached_property
    def point_term(self) -> PointTerm:
        """The markers as a term."""
        seen = np.where(self.solver_mask[..., None], self.marker_positions, 0.0)
        return PointTerm(self.attachment.joints, self.attachment.offsets, seen, self.solver_mask / self.marker_sd**2)

    def build_terms(self, tracking: TrackingTerm) -> tuple[PointTerm, TrackingTerm, PosePriorTerm, JointLimitTerm]:
        """-> all that holds the poses, with this pull."""
        return self.point_term, tracking, self.pose_prior, self.joint_limits

    def normalise_robust_scales(self, scales: tuple[float, ...]) -> np.ndarray:
        """-> robust scales in metres as the kernels want them: squared, in units of marker_sd."""
        return (np.array(scales) / self.marker_sd) ** 2

    def solve(
        self, root, local, tracking: TrackingTerm, scales: tuple[float, ...], max_iterations: int = MAX_ITERATIONS_PER_SCALE
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move every frame's pose to where its cost is least, through the robust scales (metres). -> status, iterations

        A frame whose root is NaN has no pose yet and goes on from where the one before it ended; all others are for themselves.
        """
        order = frame_order.order_sequentially(~np.isnan(root[:, 0]), local.shape[1])
        return self.solve_in_order(order, root, local, tracking, scales, max_iterations)

    def solve_from_neighbours(self, root, local, tracking: TrackingTerm, uncertain_joints: np.ndarray, scale: float) -> None:
        """Solve the frames with unsure joints (T, J) anew, each from its neighbour, from both ends of their runs inwards."""
        self.solve_in_order(
            frame_order.order_from_gap_ends(find_runs(np.any(uncertain_joints, axis=1)), uncertain_joints),
            root,
            local,
            tracking,
            (scale,),
            MAX_ITERATIONS_PER_SCALE,
        )

    def solve_in_order(
        self,
        solve_order: frame_order.SolveOrder,
        root,
        local,
        tracking: TrackingTerm,
        scales: tuple[float, ...],
        max_iterations: int,
    ):
        """Solve frames as a plan says. -> status, iterations, 0 where a frame is not in the plan"""
        terms, status, iterations = self.build_terms(tracking), np.zeros(len(root), int), np.zeros(len(root), int)
        run_over_frames(
            solve_frames, len(solve_order.chain_starts) - 1, self.tree, terms, solve_order, self.normalise_robust_scales(scales), INITIAL_DAMPING_RATIO, max_iterations,
            count_rows(terms), root, local, np.zeros((len(root), 0)), status, iterations,
        )  # fmt: skip
        return status, iterations

    def compute_uncertainty(self, root, local, tracking: TrackingTerm, scale: float) -> PoseUncertainty:
        """-> how sure the poses are, given a pull (metres: the robust scale)."""
        frames, joints = local.shape[:2]
        each, terms = (frames, joints), self.build_terms(tracking)
        left = PoseUncertainty(np.zeros(self.solver_mask.shape), np.zeros(each), np.zeros(each), np.zeros(frames))
        run_over_frames(
            compute_uncertainty_frames, frames, self.tree, terms, self.normalise_robust_scales((scale,))[0], count_rows(terms), root, local,
            np.zeros((frames, 0)), *left,
        )  # fmt: skip
        return left

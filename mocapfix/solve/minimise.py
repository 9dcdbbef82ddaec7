"""The one way of minimising: the poses of least cost under terms, each frame by Levenberg-Marquardt.

The cost of a frame is the sum of its terms (`terms`, `model_terms`), each half a sum of squares in standard deviations. Nothing
else calls the kernels of the solver: bodies, contacts, retargeting, priors and benchmarks pass their terms to `minimise`.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import (
    INITIAL_DAMPING_RATIO,
    MIN_COST_DECREASE,
    compute_cost_frames,
    solve_frames,
)
from mocapfix.kernels.terms import count_rows
from mocapfix.model.motion import PoseUncertainty
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.parallel import SolveOrder, order_independently, run_over_frames

NEGLIGIBLE_COST_DECREASE = MIN_COST_DECREASE
"""Decrease of the cost that does not count."""

KernelTerms: TypeAlias = tuple[Any, ...]
"""Terms of the kernels; a tuple, since the kernels are compiled for the classes in it, in this order."""


@dataclass(frozen=True)
class SolverSettings:
    """How a cost is minimised.

    Attributes:
        squared_robust_scales: Of the robust terms in standard deviations; the solve runs through them, from wide to narrow.
        max_iterations: Of a frame at each scale.
        damping_ratio: Initial damping over the largest curvature: small for a good start.
        order: The frames that are solved, and the frames that they start from; None: all, each from its own start.
    """

    squared_robust_scales: tuple[float, ...] = (math.inf,)
    max_iterations: int = 20
    damping_ratio: float = INITIAL_DAMPING_RATIO
    order: SolveOrder | None = None


@dataclass(frozen=True)
class PoseSolution:
    """The poses of T frames at the end of a solve.

    Attributes:
        root_position: Positions of the root in metres, (T, 3).
        local_rotations: Rotations of the joints, joint axes to parent axes, (T, J, 3, 3).
        codes: Codes of the pose model, each number in its own standard deviations, (T, P); P is 0 without one.
        status: A FrameStatus for each frame, (T,).
        iterations: Iterations of each frame, (T,); 0 for frames that were not solved.
        cost: Cost of each frame under a pose model and the other terms, (T,), NaN without a model (see `compute_costs`). For a
            mixture it includes the cost of the component relative to the cheapest: the logarithm of its spread over its weight.
    """

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    codes: Float[np.ndarray, "T P"]
    status: Int[np.ndarray, " T"]
    iterations: Int[np.ndarray, " T"]
    cost: Float[np.ndarray, " T"]

    @property
    def poses(self) -> Poses:
        """Root positions and local rotations."""
        return self.root_position, self.local_rotations

    def select_frames(self, frames: slice) -> "PoseSolution":
        """Return the solution of some frames."""
        return PoseSolution(*(each[frames].copy() for each in vars(self).values()))


class IteratedTerm(ABC):
    """A term that the kernels cannot evaluate: it is linearised, and linearised again between rounds of iterations."""

    @abstractmethod
    def minimise_in_rounds(
        self, tree: KinematicTree, other_terms: KernelTerms, start: Poses, settings: SolverSettings
    ) -> PoseSolution:
        """Return the poses of least cost under this term and those of the kernels."""


def minimise(tree: KinematicTree, terms: KernelTerms, start: Poses, settings: SolverSettings | None = None) -> PoseSolution:
    """Return the poses of least cost.

    Args:
        tree: The skeleton of J joints.
        terms: The terms of the kernels; the last may be an `IteratedTerm`, such as a pose model.
        start: Root positions (T, 3) in metres and local rotations (T, J, 3, 3); not modified.
        settings: How to minimise.
    """
    settings = settings or SolverSettings()
    if isinstance(terms[-1], IteratedTerm):
        return terms[-1].minimise_in_rounds(tree, terms[:-1], start, settings)
    root_position, local_rotations = (np.array(each, float, order="C") for each in start)
    frame_count, joint_count = local_rotations.shape[:2]
    status, iterations = np.zeros((2, frame_count), int)
    solution = PoseSolution(
        root_position, local_rotations, np.zeros((frame_count, 0)), status, iterations, np.full(frame_count, np.nan)
    )
    order = settings.order or order_independently(np.arange(frame_count), joint_count)
    run_over_frames(
        solve_frames, len(order.chain_starts) - 1, tree, terms, order, np.array(settings.squared_robust_scales, float),
        settings.damping_ratio, settings.max_iterations, count_rows(terms), *solution.poses, solution.codes, status, iterations,
    )  # fmt: skip
    return solution


def iterate_frames(
    tree: KinematicTree,
    terms: KernelTerms,
    frames: Int[np.ndarray, " N"],
    poses: Poses,
    codes: Float[np.ndarray, "T P"],
    status: Int[np.ndarray, " T"],
    settings: SolverSettings,
) -> Int[np.ndarray, " N"]:
    """Solve some frames in place, in this thread, for a round of an `IteratedTerm`. Return their iterations."""
    iterations = np.zeros(len(codes), int)
    order = order_independently(frames, poses[1].shape[1])
    solve_frames(
        tree, terms, order, np.array(settings.squared_robust_scales, float), settings.damping_ratio, settings.max_iterations,
        count_rows(terms), *poses, codes, status, iterations, 0, len(frames),
    )  # fmt: skip
    return iterations[frames]


def compute_costs(
    tree: KinematicTree,
    terms: KernelTerms,
    poses: Poses,
    squared_robust_scale: float = math.inf,
    *,
    codes: Float[np.ndarray, "T P"] | None = None,
    frames: Int[np.ndarray, " N"] | None = None,
) -> Float[np.ndarray, " N"]:
    """Return the cost of poses: half the sum of squares in standard deviations, robust for robust terms.

    Args:
        tree: The skeleton.
        terms: The terms of the kernels.
        poses: Root positions in metres and local rotations of T frames.
        squared_robust_scale: In standard deviations.
        codes: Unknowns of a pose model, if there is a term of one.
        frames: The frames whose cost is computed; by default all.
    """
    frames = np.arange(len(poses[0])) if frames is None else frames
    cost, shared = np.zeros(len(frames)), np.zeros((len(poses[0]), 0)) if codes is None else codes
    compute_cost_frames(tree, terms, frames, squared_robust_scale, count_rows(terms), *poses, shared, cost)
    return cost


def compute_uncertainty(
    tree: KinematicTree,
    terms: KernelTerms,
    poses: Poses,
    squared_robust_scale: float = math.inf,
    *,
    codes: Float[np.ndarray, "T P"] | None = None,
) -> PoseUncertainty:
    """Return the uncertainty of poses from the curvature of the cost; the first term must be that of the markers.

    The arguments are those of `compute_costs`.
    """
    frame_count, joint_count = poses[1].shape[:2]
    uncertainty = PoseUncertainty(
        np.zeros((frame_count, len(terms[0].joints))),
        np.zeros((frame_count, joint_count)),
        np.zeros((frame_count, joint_count)),
        np.zeros(frame_count),
    )
    shared, rows = np.zeros((frame_count, 0)) if codes is None else codes, count_rows(terms)
    run_over_frames(
        compute_uncertainty_frames, frame_count, tree, terms, squared_robust_scale, rows, *poses, shared, *uncertainty
    )
    return uncertainty

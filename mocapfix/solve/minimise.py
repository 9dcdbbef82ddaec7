"""The one way of minimising: the poses of least cost under terms, each frame by Levenberg-Marquardt.

The cost of a frame is the sum of its terms (`terms`, `model_terms`), each half a sum of squares in standard deviations. Nothing
else calls the kernels of the solver: bodies, contacts, retargeting, priors and benchmarks pass their terms to `minimise`.

Unknowns that frames share, such as the bones of a person, are minimised by damped steps too. At each step the poses of the
frames are solved again and eliminated exactly (variable projection; Golub & Pereyra 1973): the pose of each frame adapts to a
change of the body, so that the sum over the frames gives curvature and gradient of the cost whose poses are solved.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, MIN_COST_DECREASE, compute_cost_frames, solve_frames
from mocapfix.kernels.schur import COLUMNS, sum_pose_responses
from mocapfix.kernels.terms import count_rows
from mocapfix.model.motion import PoseUncertainty
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.parallel import SolveOrder, order_independently, run_over_frames
from mocapfix.solve.terms import BodyTerms

NEGLIGIBLE_COST_DECREASE = MIN_COST_DECREASE  # decrease of the cost that does not count

KernelTerms: TypeAlias = tuple[Any, ...]
"""Terms of the kernels; a tuple, since the kernels are compiled for the classes in it, in this order."""


@dataclass(frozen=True)
class SolverSettings:
    """How a cost is minimised.

    Attributes:
        squared_robust_scales: Of the robust terms in standard deviations; the solve runs through them, from wide to narrow.
        order: The frames that are solved, and the frames that they start from; None: all, each from its own start.
    """

    squared_robust_scales: tuple[float, ...] = (math.inf,)
    max_iterations: int = 20  # of a frame at each scale
    damping_ratio: float = INITIAL_DAMPING_RATIO  # initial damping over the largest curvature: small for a good start
    order: SolveOrder | None = None


@dataclass(frozen=True)
class PoseSolution:
    """The poses of T frames at the end of a solve.

    Attributes:
        codes: Codes of the pose model, each number in its own standard deviations, (T, P); P is 0 without one.
        cost: Cost of each frame under a pose model and the other terms, (T,), NaN without a model (see `compute_costs`). For a
            mixture it includes the cost of the component relative to the cheapest: the logarithm of its spread over its weight.
    """

    root_position: Float[np.ndarray, "T 3"]  # positions of the root in metres, (T, 3)
    local_rotations: Float[np.ndarray, "T J 3 3"]  # rotations of the joints, joint axes to parent axes, (T, J, 3, 3)
    codes: Float[np.ndarray, "T P"]
    status: Int[np.ndarray, " T"]  # a FrameStatus for each frame, (T,)
    iterations: Int[np.ndarray, " T"]  # iterations of each frame, (T,); 0 for frames that were not solved
    cost: Float[np.ndarray, " T"]

    @property
    def poses(self) -> Poses:
        """Root positions and local rotations."""
        return self.root_position, self.local_rotations

    def select_frames(self, frames: slice) -> "PoseSolution":
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
    of_joints, of_markers = (frame_count, joint_count), (frame_count, len(terms[0].joints))
    uncertainty = PoseUncertainty(np.zeros(of_markers), np.zeros(of_joints), np.zeros(of_joints), np.zeros(frame_count))
    shared, rows = np.zeros((frame_count, 0)) if codes is None else codes, count_rows(terms)
    run_over_frames(
        compute_uncertainty_frames, frame_count, tree, terms, squared_robust_scale, rows, *poses, shared, *uncertainty
    )
    return uncertainty


INITIAL_DAMPING = 1e-3  # marquardt damping of the shared unknowns at the start
MIN_DAMPING = 1e-6  # smallest damping after accepted steps
MAX_DAMPING = 1e3  # damping above which the search ends without an accepted step
MIN_RELATIVE_DECREASE = 1e-3  # relative decrease of the cost below which the search ends
MIN_CURVATURE_CHANGE_DECREASE = 0.02
"""Relative decrease of the cost above which the curvature is computed again; after smaller steps it is nearly the same."""


@runtime_checkable
class SharedState(Protocol):
    """Shared unknowns (Q,), and cost and gradient (Q,) there, with the poses of the frames solved."""

    @property
    def unknowns(self) -> np.ndarray: ...
    @property
    def cost(self) -> float: ...
    @property
    def gradient(self) -> np.ndarray: ...


State = TypeVar("State", bound=SharedState)


def minimise_shared(
    fit: Callable[[np.ndarray, State], State],
    start: State,
    compute_curvature: Callable[[State], Float[np.ndarray, "Q Q"]],
    max_rounds: int,
) -> tuple[State, Float[np.ndarray, "Q Q"]]:
    """Return the state of least cost, and the curvature there or near it, by damped Gauss-Newton steps (Marquardt 1963).

    Args:
        fit: Returns the state at other unknowns, whose poses start from those of a state.
        start: The first state.
        compute_curvature: Returns the curvature at a state.
        max_rounds: Steps of the shared unknowns.
    """
    state, curvature, damping = start, compute_curvature(start), INITIAL_DAMPING
    for _ in range(max_rounds):
        step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -state.gradient)
        trial = fit(state.unknowns + step, state)
        if trial.cost < state.cost:
            decrease = (state.cost - trial.cost) / trial.cost
            state, damping = trial, max(damping / 5, MIN_DAMPING)
            if decrease < MIN_RELATIVE_DECREASE:
                break
            if decrease > MIN_CURVATURE_CHANGE_DECREASE:
                curvature = compute_curvature(state)
        else:
            damping *= 10
            if damping > MAX_DAMPING:
                break
    return state, curvature


class SharedResponses(NamedTuple):
    """Changes of T frames with U unknowns, each frame's pose adapting, in metres per unit.

    The unknowns are the offsets of J joints and of K markers and the mean pose of F joints, see `kernels.schur`.
    """

    cost: Float[np.ndarray, " T"]  # half the sum of squares, all terms included
    gradient: Float[np.ndarray, " U"]  # of the cost, summed over frames
    curvature: Float[np.ndarray, "U columns"]  # likewise; without columns if only the errors were computed
    marker_weight: Float[np.ndarray, "T K"]  # 1/m^2, robust
    marker_response: Float[np.ndarray, "T K 3 columns"]  # of markers, in their joints' axes; without columns unless asked for
    joint_response: Float[np.ndarray, "T J 3 columns"]  # of joints, in world axes; likewise


def compute_shared_responses(
    tree: KinematicTree,
    terms: BodyTerms,
    squared_robust_scale: float,
    poses: Poses,
    *,
    only_errors: bool = False,
    has_responses: bool = False,
) -> SharedResponses:
    """Return the responses of frames at their solved poses, computed in this thread.

    Args:
        squared_robust_scale: In units of the markers' standard deviation.
        only_errors: Compute the remaining errors after each pose's own next step, and from them the gradient, only.
        has_responses: Return the responses of markers and joints.
    """
    (frames, joints), markers, rotating = poses[1].shape[:2], len(terms[0].joints), np.flatnonzero(tree.free)[1:]
    own = 3 * (joints + markers)  # first unknown of the mean pose
    unknowns = own + 3 * len(rotating)
    width, blocks = (1, 1) if only_errors else (COLUMNS, unknowns // COLUMNS + 1)
    cost, marker_weight, products = np.empty(frames), np.empty((frames, markers)), np.zeros((blocks, unknowns, width))
    responses = [np.zeros((frames, blocks, points, 3, width if has_responses else 0)) for points in (markers, joints)]
    sum_pose_responses(tree, terms, rotating, squared_robust_scale, *poses, cost, marker_weight, products, *responses)
    found = products.swapaxes(0, 1).reshape(unknowns, -1)[:, : unknowns + 1]
    if not only_errors:
        found[own:, own:unknowns] -= frames * np.eye(unknowns - own)  # the deviation from the mean pose by itself
    of_prior = found[own:].reshape(len(rotating), 3, found.shape[1])
    found[own:] = -(terms[2].information[0, rotating] @ of_prior).reshape(-1, found.shape[1])
    shapes = ((frames, each.shape[2], 3, blocks * each.shape[4]) for each in responses)
    responses = (np.moveaxis(each, 1, 3).reshape(shape)[..., :unknowns] for each, shape in zip(responses, shapes, strict=True))
    return SharedResponses(cost, found[:, -1], found[:, :-1], marker_weight, *responses)

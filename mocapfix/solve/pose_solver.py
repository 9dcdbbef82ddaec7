"""Poses under a learned pose model, whose code is an additional unknown of the solve.

A linear model is linearised once, a network again between rounds (see `latent_solver`). In a mixture the component in which a
pose costs least represents the whole mixture until another becomes cheaper.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import LatentCodeTerm
from mocapfix.model.motion import FrameStatus
from mocapfix.solve.latent_solver import INITIAL_CODE_DAMPING, LatentSolver, SolverCallback, Terms, build_latent_term
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.pose_prior import MixtureModel, PoseModel, compute_pose_vectors

NO_ROBUST_SCALE = np.array([np.inf])
"""Squared robust scales of a solve without robust losses."""
MAX_BATCH_FRAMES = 128
"""Frames per batch; the linearisation of a network takes about 25 kB per frame."""


@dataclass(frozen=True)
class PoseSolution:
    """Solved poses.

    root_position    (T, 3) m
    local_rotations  (T, J, 3, 3)
    codes            (T, P) of the model, each number in its own standard deviations
    status           (T,) a FrameStatus for each frame
    iterations       (T,) Levenberg-Marquardt iterations over all rounds
    cost             (T,) half the sum of squares of all residuals, in standard deviations; for a mixture also the cost of the
                     component relative to the cheapest one: the logarithm of its spread over its weight
    """

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    codes: Float[np.ndarray, "T P"]
    status: Int[np.ndarray, " T"]
    iterations: Int[np.ndarray, " T"]
    cost: Float[np.ndarray, " T"]


def solve_poses(
    tree: KinematicTree,
    other_terms: Terms,
    model: PoseModel,
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    codes: Float[np.ndarray, "T P"] | None = None,
    *,
    prior_scale: float = 1.0,
    squared_robust_scales: np.ndarray = NO_ROBUST_SCALE,
    max_iterations: int = 30,
    callback: SolverCallback | None = None,
    build_solver: Callable[..., LatentSolver] | None = None,
) -> PoseSolution:
    """Return the poses of least cost under a pose model and other terms, each frame independently.

    other_terms                     the terms besides the model
    root_position, local_rotations  the start, in metres; not modified
    codes                           the start; by default the mean code
    prior_scale                     factor of the model's standard deviations (2: weaker prior)
    squared_robust_scales           of the other terms, from wide to narrow
    max_iterations                  per frame; a round that was started is completed
    callback                        called after each round with the poses and codes of all frames
    build_solver                    returns the state of a solve; by default the type that suits the model
    """
    codes = np.zeros((len(root_position), model.code_size)) if codes is None else codes
    build_solver = build_solver or (MixtureSolver if isinstance(model, MixtureModel) else LatentSolver)
    solver = build_solver(tree, other_terms, model, prior_scale, root_position, local_rotations, codes)
    frames = np.arange(len(root_position))
    batches = np.array_split(frames, 1 if callback else -(-len(frames) // MAX_BATCH_FRAMES)) if len(frames) else []
    if model.is_linear:
        terms = (build_latent_term(tree, model, prior_scale, codes[:1] / prior_scale, 0.0, solver.batch_rows),)
        run_in_parallel(
            partial(solver.run_iterations, terms, INITIAL_CODE_DAMPING, squared_robust_scales, max_iterations), batches
        )
        solver.cost = solver.compute_costs(terms, squared_robust_scales[-1], frames)
        if callback:
            callback(solver.root_position, solver.local_rotations, prior_scale * solver.scaled_codes)
    else:
        run_in_parallel(partial(solver.solve_batch, squared_robust_scales, max_iterations, callback), batches)
    return PoseSolution(
        solver.root_position,
        solver.local_rotations,
        prior_scale * solver.scaled_codes,
        solver.status,
        solver.iterations,
        solver.cost,
    )


class MixtureSolver(LatentSolver):
    """A solve under a mixture; codes given without a component are ignored, each frame starts with the code of its pose.

    Within a component the problem is linear, so that no round increases the cost. A frame is done when it has converged in the
    component that is the cheapest for its pose.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        model = self.model
        self.mixture: MixtureModel = replace(model, component_cholesky=self.prior_scale * model.component_cholesky)
        # cost of each component in addition to that of its code
        self.component_costs = self.mixture.component_offsets - self.mixture.component_offsets.min()
        self.component_index = np.full(len(self.root_position), -1)
        self.mean_rotations = np.ascontiguousarray(model.reference_rotations)
        self.information = model.residual_information / self.prior_scale**2 * self.tree.free[:, None, None]

    def linearise(self, batch: np.ndarray) -> tuple[LatentCodeTerm]:
        """Select each frame's component; where it changed, the code becomes that of the pose in the new component."""
        vectors = compute_pose_vectors(self.local_rotations[batch], self.mean_rotations)
        selected = self.mixture.select_components(vectors)
        has_changed = selected.component_index != self.component_index[batch]
        self.scaled_codes[batch[has_changed]] = selected.encode(vectors)[has_changed]
        self.component_index[batch], self.batch_rows[batch] = selected.component_index, np.arange(len(batch))
        codes = self.scaled_codes[batch]
        decoded, jacobian = selected.linearise(codes)
        no_stiffness = np.zeros(len(codes))
        return (
            LatentCodeTerm.build(self.mean_rotations, decoded, jacobian, codes, self.information, no_stiffness, self.batch_rows),
        )

    def relinearise(self, model_terms: Terms, batch: np.ndarray) -> tuple[LatentCodeTerm]:
        """Linearise again: components may have changed."""
        return self.linearise(batch)

    def run_round(
        self,
        model_terms: Terms,
        damping: float,
        squared_robust_scales: np.ndarray,
        max_iterations: int,
        batch: np.ndarray,
    ) -> None:
        """Solve within the selected components; frames for which another component is cheaper then need another round."""
        self.run_iterations(model_terms, damping, squared_robust_scales, max_iterations, batch)
        code_costs = self.compute_costs(model_terms, squared_robust_scales[-1], batch)
        self.cost[batch] = code_costs + self.component_costs[self.component_index[batch]]
        vectors = compute_pose_vectors(self.local_rotations[batch], self.mean_rotations)
        cheapest = self.mixture.select_components(vectors).component_index
        self.status[batch[cheapest != self.component_index[batch]]] = FrameStatus.ITERATION_LIMIT

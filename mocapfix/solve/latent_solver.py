"""Latent solver: poses under a model that is linear only near the codes at which it was linearised.

A network is evaluated between rounds of a few iterations, for many frames at once, and only for frames that have not converged.
Its value is evaluated after each round, at negligible cost, but its derivative only in the first two rounds and after a round
that failed. In between, the derivative is updated from the steps (Broyden 1965). A penalty keeps the code near the point of
linearisation. If a round ends at a higher actual cost than it began with, it is undone and the penalty is increased. This is the
method of Levenberg and Marquardt applied a second time, to what the inner solve treats as linear.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import MIN_COST_DECREASE, compute_cost_frames, solve_frames
from mocapfix.kernels.terms import LatentCodeTerm, count_rows
from mocapfix.kernels.terms.latent_code import update_code_curvature, update_linearisations
from mocapfix.model.motion import FrameStatus
from mocapfix.solve.parallel import order_independently
from mocapfix.solve.pose_prior import PoseModel

INITIAL_CODE_DAMPING = 1e-3
"""Initial damping relative to the largest curvature, from a start that may be far from the solution."""
RESTART_CODE_DAMPING = 1e-6
"""The same, from the end of the round before."""
MAX_ROUND_ITERATIONS = 6
"""Iterations of a round at each robust scale; more would rely on a linearisation that is no longer valid."""
INITIAL_CODE_STIFFNESS = 2.0
"""Initial weight of the penalty that keeps a code near its linearisation."""
CODE_STIFFNESS_GROWTH = 3.0
"""Factor of this weight after a round that failed."""
MIN_ROUND_COST_DECREASE = 0.2
"""Decrease of the cost (half a sum of squares in standard deviations) in a round below which no further round follows."""

SolverCallback = Callable[[np.ndarray, np.ndarray, np.ndarray], None]
"""A function of the root positions, local rotations and codes of all frames."""
Terms = tuple[Any, ...]
"""Terms of the kernels, see `kernels.terms`."""


def build_latent_term(
    tree: KinematicTree,
    model: PoseModel,
    prior_scale: float,
    scaled_codes: np.ndarray,
    stiffness: float,
    batch_rows: np.ndarray,
) -> LatentCodeTerm:
    """Return a pose model as a term, linearised at codes of `prior_scale` times `scaled_codes` (D, P).

    prior_scale  factor of the model's standard deviations
    stiffness    weight of the penalty that keeps the codes near the linearisation
    batch_rows   row of each frame among the D linearisations
    """
    is_common = (scaled_codes == scaled_codes[0]).all()  # at the start all codes are equal
    distinct, repeats = (scaled_codes[:1], len(scaled_codes)) if is_common else (scaled_codes, 1)
    decoded, jacobian = model.linearise(prior_scale * distinct)
    information = model.residual_information / prior_scale**2 * tree.free[:, None, None]
    stiffnesses = np.full(len(scaled_codes), stiffness)
    term = LatentCodeTerm.build(
        model.reference_rotations, decoded, prior_scale * jacobian, distinct, information, stiffnesses, batch_rows
    )
    repeated = {name: np.repeat(getattr(term, name), repeats, axis=0) for name in ("decoded", "jacobian", "code", "curvature")}
    return term._replace(**repeated)


class LatentSolver:
    """The state of a solve. Its unknowns are codes divided by `prior_scale`, so that each costs half its square.

    status, iterations, cost  (T,) as in `PoseSolution`
    code_stiffness            (T,) weight of the penalty that keeps a code near its linearisation
    batch_rows                (T,) row of each frame in its batch
    is_jacobian_stale         (T,) whether a frame's derivative must be evaluated before the next round
    """

    def __init__(
        self,
        tree: KinematicTree,
        other_terms: Terms,
        model: Any,
        prior_scale: float,
        root_position: np.ndarray,
        local_rotations: np.ndarray,
        codes: np.ndarray,
    ) -> None:
        frames = len(root_position)
        self.tree, self.other_terms, self.model, self.prior_scale = tree, other_terms, model, prior_scale
        self.root_position = np.array(root_position, float, order="C")
        self.local_rotations = np.array(local_rotations, float, order="C")
        self.scaled_codes = np.array(codes / prior_scale, float, order="C")
        self.status, self.iterations = np.full(frames, FrameStatus.ITERATION_LIMIT), np.zeros(frames, int)
        self.cost, self.code_stiffness = np.zeros(frames), np.full(frames, INITIAL_CODE_STIFFNESS)
        self.batch_rows, self.is_jacobian_stale = np.zeros(frames, int), np.full(frames, True)

    def solve_batch(
        self,
        squared_robust_scales: np.ndarray,
        max_iterations: int,
        callback: SolverCallback | None,
        batch: np.ndarray,
    ) -> None:
        """Solve a batch of frames, linearising the model between rounds; the first round uses all robust scales."""
        model_terms, damping = self.linearise(batch), INITIAL_CODE_DAMPING
        self.cost[batch] = self.compute_costs(model_terms, squared_robust_scales[-1], batch)
        while len(batch):
            self.run_round(model_terms, damping, squared_robust_scales, min(MAX_ROUND_ITERATIONS, max_iterations), batch)
            if callback:
                callback(self.root_position, self.local_rotations, self.prior_scale * self.scaled_codes)
            batch = batch[(self.status[batch] == FrameStatus.ITERATION_LIMIT) & (self.iterations[batch] < max_iterations)]
            damping, squared_robust_scales = RESTART_CODE_DAMPING, squared_robust_scales[-1:]
            model_terms = self.relinearise(model_terms, batch) if len(batch) else model_terms

    def linearise(self, batch: np.ndarray) -> Terms:
        """Return the model's terms, linearised at the poses of a batch."""
        self.batch_rows[batch] = np.arange(len(batch))
        codes = self.scaled_codes[batch]
        return (build_latent_term(self.tree, self.model, self.prior_scale, codes, INITIAL_CODE_STIFFNESS, self.batch_rows),)

    def relinearise(self, model_terms: Terms, batch: np.ndarray) -> Terms:
        """Return the terms for the next round, with stale derivatives evaluated again."""
        latent, frames = model_terms[0], batch[self.is_jacobian_stale[batch]]
        if len(frames):
            rows, codes, nonlinear = self.batch_rows[frames], self.scaled_codes[frames], self.model.nonlinear_code_size
            latent.decoded[rows], jacobian = self.model.linearise(self.prior_scale * codes)
            latent.jacobian[rows, ..., :nonlinear] = self.prior_scale * jacobian[..., :nonlinear]
            latent.code[rows], latent.code_weight[rows] = codes, self.code_stiffness[frames]
            self.is_jacobian_stale[frames] = False
            update_code_curvature(latent, rows, nonlinear)
        return model_terms

    def update_linearisation(self, model_terms: Terms, batch: np.ndarray) -> Terms:
        """Return the terms at the current codes of a batch, with the derivative updated from the step."""
        codes = self.scaled_codes[batch]
        decoded = self.model.decode(self.prior_scale * codes)
        update_linearisations(model_terms[0], self.batch_rows[batch], codes, decoded, self.model.nonlinear_code_size)
        return model_terms

    def run_iterations(
        self,
        model_terms: Terms,
        damping: float,
        squared_robust_scales: np.ndarray,
        max_iterations: int,
        batch: np.ndarray,
    ) -> None:
        """Solve a batch of frames with the linearised model."""
        terms, iterations = (*self.other_terms, *model_terms), np.zeros_like(self.iterations)
        order = order_independently(len(batch), self.local_rotations.shape[1])._replace(frames=batch)
        solve_frames(
            self.tree, terms, order, squared_robust_scales, damping, max_iterations, count_rows(terms), self.root_position,
            self.local_rotations, self.scaled_codes, self.status, iterations, 0, len(batch),
        )  # fmt: skip
        self.iterations[batch] += iterations[batch]

    def compute_costs(self, model_terms: Terms, squared_robust_scale: float, batch: np.ndarray) -> np.ndarray:
        """Return the costs (B,) of a batch of frames, with the model linearised at their poses."""
        terms, cost = (*self.other_terms, *model_terms), np.empty(len(batch))
        compute_cost_frames(
            self.tree, terms, batch, squared_robust_scale, count_rows(terms), self.root_position, self.local_rotations,
            self.scaled_codes, cost,
        )  # fmt: skip
        return cost

    def run_round(
        self,
        model_terms: Terms,
        damping: float,
        squared_robust_scales: np.ndarray,
        max_iterations: int,
        batch: np.ndarray,
    ) -> None:
        """Run some iterations with the linearised model, and undo them where the actual cost increased."""
        before = self.root_position[batch], self.local_rotations[batch], self.scaled_codes[batch]
        self.run_iterations(model_terms, damping, squared_robust_scales, max_iterations, batch)
        updated = self.update_linearisation(model_terms, batch)
        decrease = self.cost[batch] - self.compute_costs(updated, squared_robust_scales[-1], batch)
        is_worse, has_failed = ~(decrease >= 0), ~(decrease > -MIN_COST_DECREASE)
        for current, previous in zip((self.root_position, self.local_rotations, self.scaled_codes), before, strict=True):
            current[batch[is_worse]] = previous[is_worse]
        self.cost[batch] -= np.where(is_worse, 0.0, decrease)
        self.is_jacobian_stale[batch[is_worse]] = True
        self.code_stiffness[batch[has_failed]] *= CODE_STIFFNESS_GROWTH
        self.status[batch[has_failed | (decrease > MIN_ROUND_COST_DECREASE)]] = FrameStatus.ITERATION_LIMIT

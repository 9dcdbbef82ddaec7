"""Pose models as terms: the code of a model is an additional unknown of each frame, and costs half its square.

A model is linear only near the codes at which it was linearised. A linear model is linearised once. A network is evaluated
between rounds of a few iterations, for many frames at once, and only for frames that have not converged. Its value is evaluated
after each round, at negligible cost, but its derivative only in the first two rounds and after a round that failed. In between,
the derivative is updated from the steps (Broyden 1965). A penalty keeps the code near the point of linearisation. If a round ends
at a higher actual cost than it began with, it is undone and the penalty is increased. This is the method of Levenberg and
Marquardt applied a second time, to what the inner solve treats as linear.

In a mixture the component in which a pose costs least represents the whole mixture until another becomes cheaper.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import LatentCodeTerm
from mocapfix.kernels.terms.latent_code import update_code_curvature, update_linearisations
from mocapfix.model.motion import FrameStatus
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.minimise import (
    NEGLIGIBLE_COST_DECREASE,
    IteratedTerm,
    KernelTerms,
    PoseSolution,
    SolverSettings,
    compute_costs,
    iterate_frames,
)
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.pose_prior import MixtureModel, PoseModel, compute_pose_vectors

INITIAL_CODE_DAMPING = 1e-3  # initial damping relative to the largest curvature, from a start that may be far from the solution
RESTART_CODE_DAMPING = 1e-6  # the same, from the end of the round before
MAX_ROUND_ITERATIONS = 6  # iterations of a round at each robust scale; more would rely on a linearisation that is no longer valid
INITIAL_CODE_STIFFNESS = 2.0  # initial weight of the penalty that keeps a code near its linearisation
CODE_STIFFNESS_GROWTH = 3.0  # factor of this weight after a round that failed
MIN_ROUND_COST_DECREASE = 0.2  # of half a sum of squares in standard deviations; with less no round follows
MAX_BATCH_FRAMES = 128  # frames per batch; the linearisation of a network takes about 25 kB per frame


@dataclass(frozen=True)
class PoseModelTerm(IteratedTerm):
    """A trained model of poses, with a code as an additional unknown.

    Attributes:
        start_codes: The codes (T, P) at the start, each number in its own standard deviations; None: the mean code.
    """

    model: PoseModel  # the model
    prior_scale: float = 1.0  # factor of the model's standard deviations (2: weaker prior)
    start_codes: Float[np.ndarray, "T P"] | None = None

    def minimise_in_rounds(
        self, tree: KinematicTree, other_terms: KernelTerms, start: Poses, settings: SolverSettings
    ) -> PoseSolution:
        """Return the poses of least cost under the model and other terms, each frame independently.

        `max_iterations` are those of a frame in all rounds; a round that was started is completed.
        """
        kind = MixtureRounds if isinstance(self.model, MixtureModel) else LinearRounds if self.model.is_linear else ModelRounds
        codes = np.zeros((len(start[0]), self.model.code_size)) if self.start_codes is None else self.start_codes
        return kind(tree, other_terms, self.model, self.prior_scale, start, codes).minimise(settings)


def linearise_model_term(
    tree: KinematicTree, model: PoseModel, prior_scale: float, scaled_codes: np.ndarray, stiffness: float, batch_rows: np.ndarray
) -> LatentCodeTerm:
    """Return a pose model as a term of the kernels, linearised at codes of `prior_scale` times `scaled_codes` (D, P).

    Args:
        prior_scale: Factor of the model's standard deviations.
        stiffness: Weight of the penalty that keeps the codes near the linearisation.
        batch_rows: Row of each frame among the D linearisations.
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


class ModelRounds:
    """The state of a solve in rounds. Its unknowns are codes divided by `prior_scale`, so that each costs half its square.

    Attributes:
        status, iterations, cost: Of each frame, (T,), as in `PoseSolution`.
        code_stiffness: Weight of the penalty that keeps a code near its linearisation, (T,).
        batch_rows: Row of each frame in its batch, (T,).
        is_jacobian_stale: Whether a frame's derivative must be evaluated before the next round, (T,).
    """

    def __init__(
        self, tree: KinematicTree, other_terms: KernelTerms, model: Any, prior_scale: float, start: Poses, codes: np.ndarray
    ) -> None:
        frames = len(codes)
        self.tree, self.other_terms, self.model, self.prior_scale = tree, other_terms, model, prior_scale
        self.root_position, self.local_rotations = (np.array(each, float, order="C") for each in start)
        self.scaled_codes = np.array(codes / prior_scale, float, order="C")
        self.status, self.iterations = np.full(frames, FrameStatus.ITERATION_LIMIT), np.zeros(frames, int)
        self.cost, self.code_stiffness = np.zeros(frames), np.full(frames, INITIAL_CODE_STIFFNESS)
        self.batch_rows, self.is_jacobian_stale = np.zeros(frames, int), np.full(frames, True)

    def minimise(self, settings: SolverSettings) -> PoseSolution:
        """Return the poses of least cost of all frames, solved in batches."""
        frames = np.arange(len(self.cost))
        batches = np.array_split(frames, -(-len(frames) // MAX_BATCH_FRAMES)) if len(frames) else []
        run_in_parallel(lambda batch: self.solve_batch(settings, batch), batches)
        codes = self.prior_scale * self.scaled_codes
        return PoseSolution(self.root_position, self.local_rotations, codes, self.status, self.iterations, self.cost)

    def solve_batch(self, settings: SolverSettings, batch: np.ndarray) -> None:
        """Solve a batch of frames, linearising the model between rounds; the first round uses all robust scales."""
        limit, last_scale = settings.max_iterations, settings.squared_robust_scales[-1:]
        settings = replace(settings, max_iterations=min(MAX_ROUND_ITERATIONS, limit), damping_ratio=INITIAL_CODE_DAMPING)
        model_terms = self.linearise(batch)
        self.cost[batch] = self.compute_costs(model_terms, last_scale[0], batch)
        while len(batch):
            self.run_round(model_terms, settings, batch)
            batch = batch[(self.status[batch] == FrameStatus.ITERATION_LIMIT) & (self.iterations[batch] < limit)]
            settings = replace(settings, damping_ratio=RESTART_CODE_DAMPING, squared_robust_scales=last_scale)
            model_terms = self.relinearise(model_terms, batch) if len(batch) else model_terms

    def linearise(self, batch: np.ndarray) -> KernelTerms:
        """Return the model's terms, linearised at the poses of a batch."""
        self.batch_rows[batch] = np.arange(len(batch))
        codes = self.scaled_codes[batch]
        return (linearise_model_term(self.tree, self.model, self.prior_scale, codes, INITIAL_CODE_STIFFNESS, self.batch_rows),)

    def relinearise(self, model_terms: KernelTerms, batch: np.ndarray) -> KernelTerms:
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

    def update_linearisation(self, model_terms: KernelTerms, batch: np.ndarray) -> KernelTerms:
        """Return the terms at the current codes of a batch, with the derivative updated from the step."""
        codes = self.scaled_codes[batch]
        decoded = self.model.decode(self.prior_scale * codes)
        update_linearisations(model_terms[0], self.batch_rows[batch], codes, decoded, self.model.nonlinear_code_size)
        return model_terms

    def iterate(self, model_terms: KernelTerms, settings: SolverSettings, batch: np.ndarray) -> None:
        """Solve a batch of frames with the linearised model."""
        terms, poses = (*self.other_terms, *model_terms), (self.root_position, self.local_rotations)
        self.iterations[batch] += iterate_frames(self.tree, terms, batch, poses, self.scaled_codes, self.status, settings)

    def compute_costs(self, model_terms: KernelTerms, squared_robust_scale: float, batch: np.ndarray) -> np.ndarray:
        """Return the costs (B,) of a batch of frames, with the model linearised at their poses."""
        terms, poses = (*self.other_terms, *model_terms), (self.root_position, self.local_rotations)
        return compute_costs(self.tree, terms, poses, squared_robust_scale, codes=self.scaled_codes, frames=batch)

    def run_round(self, model_terms: KernelTerms, settings: SolverSettings, batch: np.ndarray) -> None:
        """Run some iterations with the linearised model, and undo them where the actual cost increased."""
        before = self.root_position[batch], self.local_rotations[batch], self.scaled_codes[batch]
        self.iterate(model_terms, settings, batch)
        updated = self.update_linearisation(model_terms, batch)
        decrease = self.cost[batch] - self.compute_costs(updated, settings.squared_robust_scales[-1], batch)
        is_worse, has_failed = ~(decrease >= 0), ~(decrease > -NEGLIGIBLE_COST_DECREASE)
        for current, previous in zip((self.root_position, self.local_rotations, self.scaled_codes), before, strict=True):
            current[batch[is_worse]] = previous[is_worse]
        self.cost[batch] -= np.where(is_worse, 0.0, decrease)
        self.is_jacobian_stale[batch[is_worse]] = True
        self.code_stiffness[batch[has_failed]] *= CODE_STIFFNESS_GROWTH
        self.status[batch[has_failed | (decrease > MIN_ROUND_COST_DECREASE)]] = FrameStatus.ITERATION_LIMIT


class LinearRounds(ModelRounds):
    """A solve under a linear model, which needs one round."""

    def minimise(self, settings: SolverSettings) -> PoseSolution:
        """Return the poses of least cost of all frames."""
        start = self.scaled_codes[:1]
        self.term = linearise_model_term(self.tree, self.model, self.prior_scale, start, 0.0, self.batch_rows)
        return super().minimise(settings)

    def solve_batch(self, settings: SolverSettings, batch: np.ndarray) -> None:
        self.iterate((self.term,), settings, batch)
        self.cost[batch] = self.compute_costs((self.term,), settings.squared_robust_scales[-1], batch)


class MixtureRounds(ModelRounds):
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
        self.component_index = np.full(len(self.cost), -1)
        self.mean_rotations = np.ascontiguousarray(model.reference_rotations)
        self.information = model.residual_information / self.prior_scale**2 * self.tree.free[:, None, None]

    def linearise(self, batch: np.ndarray) -> KernelTerms:
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

    def relinearise(self, model_terms: KernelTerms, batch: np.ndarray) -> KernelTerms:
        """Linearise again: components may have changed."""
        return self.linearise(batch)

    def run_round(self, model_terms: KernelTerms, settings: SolverSettings, batch: np.ndarray) -> None:
        """Solve within the selected components; frames for which another component is cheaper then need another round."""
        self.iterate(model_terms, settings, batch)
        code_costs = self.compute_costs(model_terms, settings.squared_robust_scales[-1], batch)
        self.cost[batch] = code_costs + self.component_costs[self.component_index[batch]]
        vectors = compute_pose_vectors(self.local_rotations[batch], self.mean_rotations)
        cheapest = self.mixture.select_components(vectors).component_index
        self.status[batch[cheapest != self.component_index[batch]]] = FrameStatus.ITERATION_LIMIT

"""Poses under a mixture: the component in which a pose costs least stands for the whole mixture, until another is cheaper.

Within a component all is linear, so that no round makes anything worse; a frame is done when it has converged in the component
that is its own there.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import LatentCodeTerm, ScalarTerm, TrackingTerm
from mocapfix.motion import FrameStatus
from mocapfix.pose_prior.mixture import MixtureModel
from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors
from mocapfix.solve.latent_solver import INITIAL_CODE_DAMPING, LatentSolver, SolverCallback, build_latent_term
from mocapfix.solve.parallel import run_in_parallel


# MERGED: mocapfix.solve.competing
class MixtureSolver(LatentSolver):
    """A solve under way. Codes of which nobody says the component mean nothing: each begins as its pose's."""

    def __init__(self, *begun):
        super().__init__(*begun)
        self.mixture = replace(self.model, spreads=self.prior_scale * self.model.spreads)
        self.component_costs = self.mixture.offsets - self.mixture.offsets.min()  # what each component costs beside its code
        self.component_index = np.full(len(self.root), -1)
        self.mean_rotations = np.ascontiguousarray(self.model.middle)
        self.information = self.model.information / self.prior_scale**2 * self.tree.free[:, None, None]

    def linearise(self, batch: np.ndarray) -> tuple[LatentCodeTerm]:
        """-> the components that are a batch's own, now; the codes of what changed its component are those of the new one."""
        vectors = compute_pose_vectors(self.local_rotations[batch], self.mean_rotations)
        near = self.mixture.select_components(vectors)
        changed = near.component_index != self.component_index[batch]
        self.scaled_codes[batch[changed]] = near.encode(vectors)[changed]
        self.component_index[batch], self.batch_rows[batch] = near.component_index, np.arange(len(batch))
        at = self.scaled_codes[batch]
        decoded, slopes = near.linearise(at)
        return (
            LatentCodeTerm.build(self.mean_rotations, decoded, slopes, at, self.information, np.zeros(len(at)), self.batch_rows),
        )

    def relinearise(self, said: tuple, batch: np.ndarray) -> tuple[LatentCodeTerm]:
        return self.linearise(batch)

    def run_round(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Go to where the component has it."""
        self.run_iterations(said, tau, scales2, most, batch)
        self.cost[batch] = self.compute_costs(said, scales2[-1], batch) + self.component_costs[self.component_index[batch]]
        now = self.mixture.select_components(
            compute_pose_vectors(self.local_rotations[batch], self.mean_rotations)
        ).component_index
        self.status[batch[now != self.component_index[batch]]] = FrameStatus.ITERATION_LIMIT


# MERGED: mocapfix.solve.natural
# Poses under the paper's number, g (MNN-IK, Eq. 3.1): one more residual, which depends on all joints.
#
# Its value and its gradient are asked for between rounds; within one the joints are held near where that was, as a code is.
class NaturalnessSolver(LatentSolver):
    """A solve under way, without a code."""

    def __init__(self, tree, others, model, scale, root, local, codes):
        super().__init__(tree, others, model.autoencoder, scale, root, local, codes)
        self.naturalness, frames = model, len(root)
        none, at = np.zeros((frames, 3)), np.empty_like(self.local_rotations)
        self.naturalness_term = ScalarTerm(
            np.empty(frames), np.empty(at.shape[:3]), at, np.full(frames, (scale * model.deviation) ** -2)
        )
        self.tracking_term = TrackingTerm(at, np.empty(at.shape[:2]), none, np.zeros(frames))

    def linearise(self, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        """-> the number, linearised where a batch of frames is, and what holds these there."""
        self.naturalness_term.reference[batch], self.tracking_term.weight[batch] = (
            self.local_rotations[batch],
            self.code_stiffness[batch, None],
        )
        self.naturalness_term.value[batch], self.naturalness_term.gradient[batch] = self.naturalness.at(
            self.local_rotations[batch]
        )
        return self.naturalness_term, self.tracking_term

    def relinearise(self, said: tuple, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        return self.linearise(batch)

    def update_linearisation(self, said: tuple, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        return self.linearise(batch)


# MERGED: mocapfix.solve.poses
# Poses under a learned model: the model's code is an unknown of the solve, its decoder linear near where it was asked.
#
# A linear model is asked once. A network is asked anew between rounds: see `search`. Mixtures and the paper's number go otherwise:
# see `competing` and `natural`.
if TYPE_CHECKING:  # for it brings torch with it
    from mocapfix.pose_prior.autoencoder import NaturalnessModel

NO_ROBUST_SCALE = np.array([np.inf])  # no robust scale
MAX_BATCH_FRAMES = 128  # frames at once: what a network says of them takes some 25 kB each


@dataclass(frozen=True)
class PoseSolution:
    """Solved poses.

    root        (T, 3) metres
    rotations   (T, J, 3, 3) local
    codes       (T, P) of the model, each number in its own standard deviations
    status      (T,) indices into motion.STATUS
    iterations  (T,) of the Levenberg-Marquardt solve, over all rounds
    cost        (T,) half the sum of squares of all residuals, in standard deviations; of a mixture also what its component costs
                beside, over the cheapest: the logarithm of its spread over its weight
    """

    root_position: np.ndarray
    local_rotations: np.ndarray
    codes: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray


def solve_poses(
    tree: KinematicTree, other_terms: tuple, model: "PoseModel | NaturalnessModel", root: np.ndarray, local_rotations: np.ndarray,
    codes: np.ndarray | None = None, *,
    prior_scale: float = 1.0, squared_robust_scales: np.ndarray = NO_ROBUST_SCALE, max_iterations: int = 30, callback: SolverCallback | None = None,
) -> PoseSolution:  # fmt: skip
    """-> the poses of least cost under a model of poses and what else is said of them, every frame for itself.

    others   the terms beside the model's
    root     (T, 3) metres and local (T, J, 3, 3): where to start; not touched
    codes    (T, P) likewise; the mean code if None
    scale    times the model's standard deviations: with 2 it is believed half as much
    scales2  squared robust scales of the other terms, wide to narrow
    most     iterations of a frame; a later round that was begun is ended
    watch    told root, local and codes of all frames after each round
    """
    codes = np.zeros((len(root), model.code_size)) if codes is None else codes
    search, frames = (
        select_solver(model)(tree, other_terms, model, prior_scale, root, local_rotations, codes),
        np.arange(len(root)),
    )
    batches = np.array_split(frames, 1 if callback else -(-len(frames) // MAX_BATCH_FRAMES)) if len(frames) else []
    if isinstance(model, PoseModel) and model.is_linear:
        once = (build_latent_term(tree, model, prior_scale, codes[:1] / prior_scale, 0.0, search.batch_rows),)
        run_in_parallel(
            partial(search.run_iterations, once, INITIAL_CODE_DAMPING, squared_robust_scales, max_iterations), batches
        )
        search.cost = search.compute_costs(once, squared_robust_scales[-1], frames)
        if callback:
            callback(search.root, search.local_rotations, prior_scale * search.scaled_codes)
    else:
        run_in_parallel(partial(search.solve_batch, squared_robust_scales, max_iterations, callback), batches)
    return PoseSolution(
        search.root, search.local_rotations, prior_scale * search.scaled_codes, search.status, search.iterations, search.cost
    )


def select_solver(model: "PoseModel | NaturalnessModel") -> type[LatentSolver]:
    """-> how such a model is searched."""
    return (
        MixtureSolver if isinstance(model, MixtureModel) else LatentSolver if isinstance(model, PoseModel) else NaturalnessSolver
    )

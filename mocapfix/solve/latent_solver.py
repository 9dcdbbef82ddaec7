"""A model of poses as the sweep wants it, linear near some codes."""

from collections.abc import Callable

import numpy as np

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import MIN_COST_DECREASE, compute_cost_frames, solve_frames
from mocapfix.kernels.terms import LatentCodeTerm, count_rows
from mocapfix.kernels.terms.latent_code import update_code_curvature, update_linearisations
from mocapfix.motion import FrameStatus
from mocapfix.pose_prior.model import PoseModel
from mocapfix.solve.frame_order import order_independently


# MERGED: mocapfix.solve.linearised
def build_latent_term(
    tree: KinematicTree, model: PoseModel, prior_scale: float, scaled_codes: np.ndarray, stiffness: float, batch_rows: np.ndarray
) -> LatentCodeTerm:
    """-> a model as a term, its deviations times `scale`, linearised at codes of scale times `shared` (D, P)."""
    alike = (scaled_codes == scaled_codes[0]).all()  # as they are at first, where nobody knows better
    told, times = scaled_codes[:1] if alike else scaled_codes, len(scaled_codes) if alike else 1
    decoded, slopes = model.linearise(prior_scale * told)
    information = model.residual_information / prior_scale**2 * tree.free[:, None, None]
    term = LatentCodeTerm.build(
        model.reference_rotations,
        decoded,
        prior_scale * slopes,
        told,
        information,
        np.full(len(scaled_codes), stiffness),
        batch_rows,
    )
    each = {name: np.repeat(getattr(term, name), times, axis=0) for name in ("decoded", "jacobian", "code", "curvature")}
    return term._replace(**each)


# MERGED: mocapfix.solve.search
# The search for poses under a model that is linear near where it was asked, and no farther.
#
# A network is asked between rounds of a few iterations, for many frames at once, and only for those that have not converged: each
# time what it says, which costs next to nothing, but how that changes with the code only in the first two rounds and after one that
# failed. Between these the derivative is mended by what each step found (Broyden 1965). The code is held where the network was
# asked, and where a round ends at a higher true cost than it began with, it is taken back and the code held more firmly.
# (Levenberg and Marquardt once more, for what the sweep takes as linear.)
INITIAL_CODE_DAMPING, RESTART_CODE_DAMPING = (
    1e-3,
    1e-6,
)  # initial damping over the largest curvature: from a start that may be far off; from the last round's end
MAX_ROUND_ITERATIONS = 6  # iterations in a round at each robust scale: more would only go by a linearisation that holds no longer
INITIAL_CODE_STIFFNESS, CODE_STIFFNESS_GROWTH = (
    2.0,
    3.0,
)  # how firmly a code is held where the decoder was asked; times this after a round that failed
MIN_ROUND_COST_DECREASE = (
    0.2  # a round's fall of the cost (half a sum of squares in standard deviations) that is not worth another round
)

SolverCallback = Callable[[np.ndarray, np.ndarray, np.ndarray], None]


class LatentSolver:
    """A solve under way. Its unknowns are codes over `scale`, so that each costs half its square."""

    def __init__(self, tree: KinematicTree, others: tuple, model, scale: float, root, local, codes):
        self.tree, self.other_terms, self.model, self.prior_scale = tree, others, model, scale
        self.root, self.local_rotations, self.scaled_codes = (
            np.array(each, float, order="C") for each in (root, local, codes / scale)
        )
        self.status, self.iterations = np.full(len(root), FrameStatus.ITERATION_LIMIT), np.zeros(len(root), int)
        self.cost, self.code_stiffness, self.batch_rows = (
            np.zeros(len(root)),
            np.full(len(root), INITIAL_CODE_STIFFNESS),
            np.zeros(len(root), int),
        )
        self.is_jacobian_stale = np.full(len(root), True)  # whether a frame's derivative is to be asked for before the next round

    def solve_batch(self, scales2: np.ndarray, most: int, watch: SolverCallback | None, batch: np.ndarray) -> None:
        """Solve a batch of frames, asking the model again between rounds; the first goes through all robust scales."""
        said, tau = self.linearise(batch), INITIAL_CODE_DAMPING
        self.cost[batch] = self.compute_costs(said, scales2[-1], batch)
        while len(batch):
            self.run_round(said, tau, scales2, min(MAX_ROUND_ITERATIONS, most), batch)
            if watch:
                watch(self.root, self.local_rotations, self.prior_scale * self.scaled_codes)
            batch = batch[(self.status[batch] == FrameStatus.ITERATION_LIMIT) & (self.iterations[batch] < most)]
            tau, scales2, said = RESTART_CODE_DAMPING, scales2[-1:], self.relinearise(said, batch) if len(batch) else said

    def linearise(self, batch: np.ndarray) -> tuple:
        """-> the model's terms, linearised where a batch of frames is."""
        self.batch_rows[batch] = np.arange(len(batch))
        return (
            build_latent_term(
                self.tree, self.model, self.prior_scale, self.scaled_codes[batch], INITIAL_CODE_STIFFNESS, self.batch_rows
            ),
        )

    def relinearise(self, said: tuple, batch: np.ndarray) -> tuple:
        """-> the same for the next round: the derivatives asked for anew where they are stale."""
        latent, frames = said[0], batch[self.is_jacobian_stale[batch]]
        if len(frames):
            rows, at, bent = self.batch_rows[frames], self.scaled_codes[frames], self.model.bent
            latent.decoded[rows], slopes = self.model.linearise(self.prior_scale * at)
            latent.jacobian[rows, ..., :bent] = self.prior_scale * slopes[..., :bent]
            latent.code[rows], latent.code_weight[rows], self.is_jacobian_stale[frames] = at, self.code_stiffness[frames], False
            update_code_curvature(latent, rows, bent)
        return said

    def update_linearisation(self, said: tuple, batch: np.ndarray) -> tuple:
        """-> the same where the batch has come to, the derivative as well as it can be told from the step."""
        at = self.scaled_codes[batch]
        update_linearisations(said[0], self.batch_rows[batch], at, self.model.decode(self.prior_scale * at), self.model.bent)
        return said

    def run_iterations(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Move a batch of frames to where the cost would be least if the model were as linear as what it `said`."""
        terms, iterations = (*self.other_terms, *said), np.zeros_like(self.iterations)
        plan = order_independently(len(batch), self.local_rotations.shape[1])._replace(frames=batch)
        solve_frames(
            self.tree, terms, plan, scales2, tau, most, count_rows(terms), self.root, self.local_rotations, self.scaled_codes, self.status,
            iterations, 0, len(batch),
        )  # fmt: skip
        self.iterations[batch] += iterations[batch]

    def compute_costs(self, said: tuple, scale2: float, batch: np.ndarray) -> np.ndarray:
        """-> (B,) what a batch of frames costs, the model's terms linearised where they are."""
        terms, cost = (*self.other_terms, *said), np.empty(len(batch))
        compute_cost_frames(
            self.tree, terms, batch, scale2, count_rows(terms), self.root, self.local_rotations, self.scaled_codes, cost
        )
        return cost

    def run_round(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Go a few iterations by what the model `said`, and back where that made it worse."""
        before = self.root[batch], self.local_rotations[batch], self.scaled_codes[batch]
        self.run_iterations(said, tau, scales2, most, batch)
        fall = self.cost[batch] - self.compute_costs(self.update_linearisation(said, batch), scales2[-1], batch)
        worse, failed = ~(fall >= 0), ~(fall > -MIN_COST_DECREASE)
        for now, then in zip((self.root, self.local_rotations, self.scaled_codes), before, strict=True):
            now[batch[worse]] = then[worse]
        self.cost[batch] -= np.where(worse, 0.0, fall)
        self.is_jacobian_stale[batch[worse]] = True
        self.code_stiffness[batch[failed]] *= CODE_STIFFNESS_GROWTH
        self.status[batch[failed | (fall > MIN_ROUND_COST_DECREASE)]] = FrameStatus.ITERATION_LIMIT

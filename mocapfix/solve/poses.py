"""Poses under a learned model: the model's code is an unknown of the solve, its decoder linear near where it was asked.

A linear model is asked once. A network is asked anew between rounds of a few iterations, for many frames at once, and only for
those that have not converged. Its linearisation is good near the code where it was asked and no farther: the code is held
there, the more firmly the oftener a round ended at a higher cost than it began with; such a round is taken back. (Levenberg
and Marquardt once more, for what the sweep takes as linear.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from mocapfix.kernels.cost import cost_frames
from mocapfix.kernels.levenberg import RAN_OUT, solve_frames
from mocapfix.kernels.plan import alone
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Latent, rows_of
from mocapfix.kernels.threads import side_by_side
from mocapfix.prior.contract import PoseModel

FAR, NEAR = 1e-3, 1e-6  # initial damping over the largest curvature: from a start that may be far off; from the last round's end
EACH = 8  # iterations in a round at each robust scale: more would only go by a linearisation that holds no longer
HOLD, FIRMER, LOOSER = 0.3, 5.0, 0.3  # how firmly a code is held where the decoder was asked; times these after each round
ENOUGH = 0.05  # a round's fall of the cost (half a sum of squares in standard deviations) that is not worth another round
PLAIN = np.array([np.inf])  # no robust scale
BATCH = 128  # frames at once: what a network says of them takes some 25 kB each

Watch = Callable[[np.ndarray, np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class Posed:
    """Solved poses.

    root        (T, 3) metres
    rotations   (T, J, 3, 3) local
    codes       (T, P) of the model, each number in its own standard deviations
    status      (T,) indices into motion.STATUS
    iterations  (T,) of the Levenberg-Marquardt solve, over all rounds
    """

    root: np.ndarray
    rotations: np.ndarray
    codes: np.ndarray
    status: np.ndarray
    iterations: np.ndarray


def under(
    tree: Tree, others: tuple, model: PoseModel, root: np.ndarray, local: np.ndarray, codes: np.ndarray | None = None, *,
    scale: float = 1.0, scales2: np.ndarray = PLAIN, most: int = 30, watch: Watch | None = None,
) -> Posed:  # fmt: skip
    """-> the poses of least cost under a model of poses and what else is said of them, every frame for itself.

    others   the terms beside the model's
    root     (T, 3) metres and local (T, J, 3, 3): where to start; not touched
    codes    (T, P) likewise; the mean code if None
    scale    times the model's standard deviations: with 2 it is believed half as much
    scales2  squared robust scales of the other terms, wide to narrow
    most     iterations of a frame; a round that was begun is ended
    watch    told root, local and codes of all frames after each round
    """
    codes = np.zeros((len(root), model.size)) if codes is None else codes
    search, frames = Search(tree, others, model, scale, root, local, codes), np.arange(len(root))
    once = search.asked(codes[:1], np.zeros(1)) if model.linear else None
    while len(frames):
        batches = np.array_split(frames, -(-len(frames) // BATCH))
        if once:
            side_by_side(partial(search.solve, once, FAR, scales2, most), batches)
            frames = frames[:0]
        else:
            side_by_side(partial(search.round, scales2), batches)
            frames = frames[(search.status[frames] == RAN_OUT) & (search.iterations[frames] < most)]
        if watch:
            watch(search.root, search.local, scale * search.shared)
    return Posed(search.root, search.local, scale * search.shared, search.status, search.iterations)


class Search:
    """A solve under way. Its unknowns are codes over `scale`, so that each costs half its square."""

    def __init__(self, tree: Tree, others: tuple, model: PoseModel, scale: float, root, local, codes):
        self.tree, self.others, self.model, self.scale = tree, others, model, scale
        self.middle, self.information = np.ascontiguousarray(model.middle), model.information / scale**2
        self.root, self.local, self.shared = root.copy(), local.copy(), codes / scale
        self.status, self.iterations = np.full(len(root), RAN_OUT), np.zeros(len(root), int)
        self.cost, self.hold, self.row = np.full(len(root), np.inf), np.full(len(root), HOLD), np.zeros(len(root), int)

    def asked(self, shared: np.ndarray, hold: np.ndarray) -> Latent:
        """-> the model linearised at unknowns (D, P), which are held there (D,)."""
        decoded, slopes = self.model.linearise(self.scale * shared)
        slopes = np.ascontiguousarray(self.scale * slopes)
        return Latent(self.middle, decoded, slopes, shared.copy(), self.information, hold, self.row)

    def solve(self, latent: Latent, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Move a batch of frames to where the cost would be least if the model were as linear as `latent` says."""
        terms, iterations = (*self.others, latent), np.zeros_like(self.iterations)
        plan = alone(len(batch), self.local.shape[1])._replace(order=batch)
        solve_frames(
            self.tree, terms, plan, scales2, tau, most, rows_of(terms), self.root, self.local, self.shared, self.status,
            iterations, 0, len(batch),
        )  # fmt: skip
        self.iterations[batch] += iterations[batch]

    def costs(self, latent: Latent, scale2: float, batch: np.ndarray) -> np.ndarray:
        """-> (B,) what a batch of frames costs, `latent` linearised at their codes."""
        terms, cost = (*self.others, latent), np.empty(len(batch))
        cost_frames(self.tree, terms, batch, scale2, rows_of(terms), self.root, self.local, self.shared, cost)
        return cost

    def round(self, scales2: np.ndarray, batch: np.ndarray) -> None:
        """Go a few iterations by one linearisation, and back where that made it worse; the first through all robust scales."""
        self.row[batch] = np.arange(len(batch))
        latent, tau = self.asked(self.shared[batch], self.hold[batch]), NEAR
        if np.isinf(self.cost[batch[0]]):
            self.cost[batch], tau = self.costs(latent, scales2[-1], batch), FAR
        before = self.root[batch], self.local[batch], self.shared[batch]
        self.solve(latent, tau, scales2 if tau == FAR else scales2[-1:], EACH, batch)
        there = latent._replace(decoded=self.model.decode(self.scale * self.shared[batch]), at=self.shared[batch])
        fall = self.cost[batch] - self.costs(there, scales2[-1], batch)
        worse = ~(fall >= 0)
        for now, then in zip((self.root, self.local, self.shared), before, strict=True):
            now[batch[worse]] = then[worse]
        self.cost[batch] -= np.where(worse, 0.0, fall)
        self.hold[batch] *= np.where(worse, FIRMER, LOOSER)
        self.status[batch[worse | (fall > ENOUGH)]] = RAN_OUT

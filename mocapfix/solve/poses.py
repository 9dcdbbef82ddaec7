"""Poses under a learned model: the model's code is an unknown of the solve, its decoder linear near where it was asked.

A linear model is asked once. A network is asked anew between rounds of a few iterations, for many frames at once, and only for
those that have not converged. Its linearisation is good near the code where it was asked and no farther: the code is held
there, the more firmly the oftener a round ended at a higher cost than it began with; such a round is taken back. (Levenberg
and Marquardt once more, for what the sweep takes as linear.) Mixtures and the paper's number go otherwise: see `competing` and
`natural`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.kernels.cost import cost_frames
from mocapfix.kernels.levenberg import RAN_OUT, solve_frames
from mocapfix.kernels.plan import alone
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Latent, rows_of
from mocapfix.kernels.threads import side_by_side
from mocapfix.prior.contract import PoseModel
from mocapfix.prior.mixture import Mixture

if TYPE_CHECKING:  # for it brings torch with it
    from mocapfix.prior.naturalness import Naturalness

FAR, NEAR = 1e-3, 1e-6  # initial damping over the largest curvature: from a start that may be far off; from the last round's end
EACH = 6  # iterations in a round at each robust scale: more would only go by a linearisation that holds no longer
HOLD, FIRMER = 2.0, 3.0  # how firmly a code is held where the decoder was asked; times this after a round that failed
ENOUGH = 0.2  # a round's fall of the cost (half a sum of squares in standard deviations) that is not worth another round
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
    cost        (T,) half the sum of squares of all residuals, in standard deviations
    """

    root: np.ndarray
    rotations: np.ndarray
    codes: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray


def under(
    tree: Tree, others: tuple, model: "PoseModel | Naturalness", root: np.ndarray, local: np.ndarray,
    codes: np.ndarray | None = None, *,
    scale: float = 1.0, scales2: np.ndarray = PLAIN, most: int = 30, watch: Watch | None = None,
) -> Posed:  # fmt: skip
    """-> the poses of least cost under a model of poses and what else is said of them, every frame for itself.

    others   the terms beside the model's
    root     (T, 3) metres and local (T, J, 3, 3): where to start; not touched
    codes    (T, P) likewise; the mean code if None
    scale    times the model's standard deviations: with 2 it is believed half as much
    scales2  squared robust scales of the other terms, wide to narrow
    most     iterations of a frame; a later round that was begun is ended
    watch    told root, local and codes of all frames after each round
    """
    codes = np.zeros((len(root), model.size)) if codes is None else codes
    search, frames = searching(model)(tree, others, model, scale, root, local, codes), np.arange(len(root))
    once = (search.asked(codes[:1], np.zeros(1)),) if model.linear else None
    while len(frames):
        batches = np.array_split(frames, -(-len(frames) // BATCH))
        if once:
            side_by_side(partial(search.solve, once, FAR, scales2, most), batches)
            frames = frames[:0]
        else:
            side_by_side(partial(search.round, scales2, most), batches)
            frames = frames[(search.status[frames] == RAN_OUT) & (search.iterations[frames] < most)]
        if watch:
            watch(search.root, search.local, scale * search.shared)
    if once:
        search.cost = search.costs(once, scales2[-1], np.arange(len(root)))
    return Posed(search.root, search.local, scale * search.shared, search.status, search.iterations, search.cost)


def linearised(model: PoseModel, scale: float, shared: np.ndarray, hold: np.ndarray, row: np.ndarray) -> Latent:
    """-> a model as a term, its deviations times `scale`, linearised at codes of scale times `shared` (D, P)."""
    told = shared[:1] if (shared == shared[0]).all() else shared  # alike as they are at first, where nobody knows better
    decoded, slopes = (np.repeat(each, len(shared) // len(told), axis=0) for each in model.linearise(scale * told))
    middle = np.ascontiguousarray(model.middle)
    return Latent(middle, decoded, scale * slopes, shared.copy(), model.information / scale**2, hold, row)


def searching(model: "PoseModel | Naturalness") -> type["Search"]:
    """-> how such a model is searched."""
    from mocapfix.solve.competing import Competing
    from mocapfix.solve.natural import Natural

    return Competing if isinstance(model, Mixture) else Search if isinstance(model, PoseModel) else Natural


class Search:
    """A solve under way. Its unknowns are codes over `scale`, so that each costs half its square."""

    def __init__(self, tree: Tree, others: tuple, model, scale: float, root, local, codes):
        self.tree, self.others, self.model, self.scale = tree, others, model, scale
        self.root, self.local, self.shared = root.copy(), local.copy(), codes / scale
        self.status, self.iterations = np.full(len(root), RAN_OUT), np.zeros(len(root), int)
        self.cost, self.hold, self.row = np.full(len(root), np.inf), np.full(len(root), HOLD), np.zeros(len(root), int)

    def asked(self, shared: np.ndarray, hold: np.ndarray) -> Latent:
        """-> the model linearised at unknowns (D, P), which are held there (D,)."""
        return linearised(self.model, self.scale, shared, hold, self.row)

    def said(self, batch: np.ndarray) -> tuple:
        """-> the model's terms, linearised where a batch of frames is."""
        self.row[batch] = np.arange(len(batch))
        return (self.asked(self.shared[batch], self.hold[batch]),)

    def said_now(self, terms: tuple, batch: np.ndarray) -> tuple:
        """-> the same for where the batch has come to, but that the slopes may be those of before."""
        latent, at = terms[0], self.shared[batch]
        return (latent._replace(decoded=self.model.decode(self.scale * at), at=at),)

    def solve(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Move a batch of frames to where the cost would be least if the model were as linear as what it `said`."""
        terms, iterations = (*self.others, *said), np.zeros_like(self.iterations)
        plan = alone(len(batch), self.local.shape[1])._replace(order=batch)
        solve_frames(
            self.tree, terms, plan, scales2, tau, most, rows_of(terms), self.root, self.local, self.shared, self.status,
            iterations, 0, len(batch),
        )  # fmt: skip
        self.iterations[batch] += iterations[batch]

    def costs(self, said: tuple, scale2: float, batch: np.ndarray) -> np.ndarray:
        """-> (B,) what a batch of frames costs, the model's terms linearised where they are."""
        terms, cost = (*self.others, *said), np.empty(len(batch))
        cost_frames(self.tree, terms, batch, scale2, rows_of(terms), self.root, self.local, self.shared, cost)
        return cost

    def round(self, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Go a few iterations by one linearisation, and back where that made it worse; the first through all robust scales."""
        said, tau = self.said(batch), NEAR
        if np.isinf(self.cost[batch[0]]):
            self.cost[batch], tau = self.costs(said, scales2[-1], batch), FAR
        before = self.root[batch], self.local[batch], self.shared[batch]
        self.solve(said, tau, scales2 if tau == FAR else scales2[-1:], min(EACH, most), batch)
        fall = self.cost[batch] - self.costs(self.said_now(said, batch), scales2[-1], batch)
        worse = ~(fall >= 0)
        for now, then in zip((self.root, self.local, self.shared), before, strict=True):
            now[batch[worse]] = then[worse]
        self.cost[batch] -= np.where(worse, 0.0, fall)
        self.hold[batch[worse]] *= FIRMER
        self.status[batch[worse | (fall > ENOUGH)]] = RAN_OUT

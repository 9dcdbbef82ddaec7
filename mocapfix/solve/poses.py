"""Poses under a learned model: the model's code is an unknown of the solve, its decoder linear near where it was asked.

A linear model is asked once. A network is asked between rounds of a few iterations, for many frames at once, and only for those
that have not converged: each time what it says, which costs next to nothing, but how that changes with the code only in the
first two rounds and after one that failed. Between these the derivative is mended by what each step found (Broyden 1965).
Such a model is good near the code where it was asked and no farther: the code is held there, and where a round ends at a higher
true cost than it began with, it is taken back and the code held more firmly. (Levenberg and Marquardt once more, for what the
sweep takes as linear.) Mixtures and the paper's number go otherwise: see `competing` and `natural`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.kernels.cost import cost_frames
from mocapfix.kernels.levenberg import RAN_OUT, SLIGHT, solve_frames
from mocapfix.kernels.plan import alone
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Latent, rows_of
from mocapfix.kernels.threads import side_by_side
from mocapfix.prior.contract import PoseModel
from mocapfix.prior.mixture import Mixture
from mocapfix.solve.linearised import linearised, mend

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
    most     iterations of a frame; a round that was begun is ended
    watch    told root, local and codes of all frames after each round
    """
    codes = np.zeros((len(root), model.size)) if codes is None else codes
    search, frames = searching(model)(tree, others, model, scale, root, local, codes), np.arange(len(root))
    batches = [frames] if watch else np.array_split(frames, -(-len(frames) // BATCH) or 1)
    once = search.asked(codes[:1]) if model.linear else None
    if once:
        side_by_side(partial(search.solve, once, FAR, scales2, most), batches)
        if watch:
            watch(search.root, search.local, scale * search.shared)
    else:
        side_by_side(partial(search.rounds, scales2, most, watch), batches)
    if once:
        search.cost = search.costs(once, scales2[-1], np.arange(len(root)))
    return Posed(search.root, search.local, scale * search.shared, search.status, search.iterations, search.cost)


def searching(model: "PoseModel | Naturalness") -> type["Search"]:
    """-> how such a model is searched."""
    from mocapfix.solve.competing import Competing
    from mocapfix.solve.natural import Natural

    return Competing if isinstance(model, Mixture) else Search if isinstance(model, PoseModel) else Natural


class Search:
    """A solve under way. Its unknowns are codes over `scale`, so that each costs half its square."""

    def __init__(self, tree: Tree, others: tuple, model, scale: float, root, local, codes):
        self.tree, self.others, self.model, self.scale = tree, others, model, scale
        self.root, self.local, self.shared = (np.array(each, float, order="C") for each in (root, local, codes / scale))
        self.status, self.iterations = np.full(len(root), RAN_OUT), np.zeros(len(root), int)
        self.cost, self.row = np.zeros(len(root)), np.zeros(len(root), int)

    def asked(self, codes: np.ndarray, hold: float = 0.0) -> Latent:
        """-> the model linearised at codes (D, P), which are held there."""
        return linearised(self.model, self.scale, codes / self.scale, hold, self.row)

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

    def rounds(self, scales2: np.ndarray, most: int, watch: Watch | None, batch: np.ndarray) -> None:
        """Solve a batch of frames, asking the model again between rounds; the first goes through all robust scales."""
        self.row[batch] = np.arange(len(batch))
        latent, tau, begun = self.asked(self.scale * self.shared[batch], HOLD), FAR, 0
        self.cost[batch] = self.costs(latent, scales2[-1], batch)
        while len(batch):
            stale = self.round(latent, tau, scales2, min(EACH, most), batch)
            batch, stale = (part[self.unfinished(part, most)] for part in (batch, stale))
            if len(batch):
                self.ask_again(latent, stale if begun else batch)
            tau, scales2, begun = NEAR, scales2[-1:], begun + 1
            if watch:
                watch(self.root, self.local, self.scale * self.shared)

    def unfinished(self, frames: np.ndarray, most: int) -> np.ndarray:
        return (self.status[frames] == RAN_OUT) & (self.iterations[frames] < most)

    def ask_again(self, latent: Latent, frames: np.ndarray) -> None:
        """Write into `latent` how what the model says of some frames changes with their codes."""
        rows = self.row[frames]
        if len(rows):
            _, slopes = self.model.linearise(self.scale * latent.at[rows])
            latent.jacobian[rows] = self.scale * slopes

    def round(self, latent: Latent, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> np.ndarray:
        """Go a few iterations by one linearisation, and back where that made it worse. -> the frames where it did

        latent  in: linearised at the frames' codes; out: likewise, its derivative mended by what the step found
        """
        rows = self.row[batch]
        before = self.root[batch], self.local[batch], self.shared[batch]
        said = latent.decoded[rows]
        self.solve(latent, tau, scales2, most, batch)
        step, latent.at[rows] = self.shared[batch] - before[2], self.shared[batch]
        latent.decoded[rows] = self.model.decode(self.scale * self.shared[batch])
        mend(latent, rows, said, step)
        fall = self.cost[batch] - self.costs(latent, scales2[-1], batch)
        worse, failed = ~(fall >= 0), ~(fall > -SLIGHT)
        for now, then in zip((self.root, self.local, self.shared), before, strict=True):
            now[batch[worse]] = then[worse]
        latent.at[rows[worse]], latent.decoded[rows[worse]] = before[2][worse], said[worse]
        latent.hold[rows[failed]] *= FIRMER
        self.cost[batch] -= np.where(worse, 0.0, fall)
        self.status[batch[failed | (fall > ENOUGH)]] = RAN_OUT
        return batch[failed]

"""The search for poses under a model that is linear near where it was asked, and no farther.

A network is asked between rounds of a few iterations, for many frames at once, and only for those that have not converged: each
time what it says, which costs next to nothing, but how that changes with the code only in the first two rounds and after one that
failed. Between these the derivative is mended by what each step found (Broyden 1965). The code is held where the network was
asked, and where a round ends at a higher true cost than it began with, it is taken back and the code held more firmly.
(Levenberg and Marquardt once more, for what the sweep takes as linear.)
"""

from collections.abc import Callable

import numpy as np

from mocapfix.kernels.cost import cost_frames
from mocapfix.kernels.levenberg import RAN_OUT, SLIGHT, solve_frames
from mocapfix.kernels.plan import alone
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import rows_of
from mocapfix.kernels.terms.latent import curve, mend
from mocapfix.solve.linearised import linearised

FAR, NEAR = 1e-3, 1e-6  # initial damping over the largest curvature: from a start that may be far off; from the last round's end
EACH = 6  # iterations in a round at each robust scale: more would only go by a linearisation that holds no longer
HOLD, FIRMER = 2.0, 3.0  # how firmly a code is held where the decoder was asked; times this after a round that failed
ENOUGH = 0.2  # a round's fall of the cost (half a sum of squares in standard deviations) that is not worth another round

Watch = Callable[[np.ndarray, np.ndarray, np.ndarray], None]


class Search:
    """A solve under way. Its unknowns are codes over `scale`, so that each costs half its square."""

    def __init__(self, tree: Tree, others: tuple, model, scale: float, root, local, codes):
        self.tree, self.others, self.model, self.scale = tree, others, model, scale
        self.root, self.local, self.shared = (np.array(each, float, order="C") for each in (root, local, codes / scale))
        self.status, self.iterations = np.full(len(root), RAN_OUT), np.zeros(len(root), int)
        self.cost, self.hold, self.row = np.zeros(len(root)), np.full(len(root), HOLD), np.zeros(len(root), int)
        self.stale = np.full(len(root), True)  # whether a frame's derivative is to be asked for before the next round

    def rounds(self, scales2: np.ndarray, most: int, watch: Watch | None, batch: np.ndarray) -> None:
        """Solve a batch of frames, asking the model again between rounds; the first goes through all robust scales."""
        said, tau = self.said(batch), FAR
        self.cost[batch] = self.costs(said, scales2[-1], batch)
        while len(batch):
            self.round(said, tau, scales2, min(EACH, most), batch)
            if watch:
                watch(self.root, self.local, self.scale * self.shared)
            batch = batch[(self.status[batch] == RAN_OUT) & (self.iterations[batch] < most)]
            tau, scales2, said = NEAR, scales2[-1:], self.said_again(said, batch) if len(batch) else said

    def said(self, batch: np.ndarray) -> tuple:
        """-> the model's terms, linearised where a batch of frames is."""
        self.row[batch] = np.arange(len(batch))
        return (linearised(self.tree, self.model, self.scale, self.shared[batch], HOLD, self.row),)

    def said_again(self, said: tuple, batch: np.ndarray) -> tuple:
        """-> the same for the next round: the derivatives asked for anew where they are stale."""
        latent, frames = said[0], batch[self.stale[batch]]
        if len(frames):
            rows, at, bent = self.row[frames], self.shared[frames], self.model.bent
            latent.decoded[rows], slopes = self.model.linearise(self.scale * at)
            latent.jacobian[rows, ..., :bent] = self.scale * slopes[..., :bent]
            latent.at[rows], latent.hold[rows], self.stale[frames] = at, self.hold[frames], False
            curve(latent, rows, bent)
        return said

    def said_now(self, said: tuple, batch: np.ndarray) -> tuple:
        """-> the same where the batch has come to, the derivative as well as it can be told from the step."""
        at = self.shared[batch]
        mend(said[0], self.row[batch], at, self.model.decode(self.scale * at), self.model.bent)
        return said

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

    def round(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Go a few iterations by what the model `said`, and back where that made it worse."""
        before = self.root[batch], self.local[batch], self.shared[batch]
        self.solve(said, tau, scales2, most, batch)
        fall = self.cost[batch] - self.costs(self.said_now(said, batch), scales2[-1], batch)
        worse, failed = ~(fall >= 0), ~(fall > -SLIGHT)
        for now, then in zip((self.root, self.local, self.shared), before, strict=True):
            now[batch[worse]] = then[worse]
        self.cost[batch] -= np.where(worse, 0.0, fall)
        self.stale[batch[worse]] = True
        self.hold[batch[failed]] *= FIRMER
        self.status[batch[failed | (fall > ENOUGH)]] = RAN_OUT

"""Poses under a mixture: the component in which a pose costs least stands for the whole mixture, until another is cheaper.

Within a component all is linear, so that no round makes anything worse; a frame is done when it has converged in the component
that is its own there.
"""

from dataclasses import replace

import numpy as np

from mocapfix.kernels.levenberg import RAN_OUT
from mocapfix.kernels.terms import Latent
from mocapfix.prior.contract import from_middle
from mocapfix.solve.search import Search


class Competing(Search):
    """A solve under way. Codes of which nobody says the component mean nothing: each begins as its pose's."""

    def __init__(self, *begun):
        super().__init__(*begun)
        self.mixture = replace(self.model, spreads=self.scale * self.model.spreads)
        self.beside = self.mixture.offsets - self.mixture.offsets.min()  # what each component costs beside its code
        self.chosen = np.full(len(self.root), -1)
        self.middle = np.ascontiguousarray(self.model.middle)
        self.information = self.model.information / self.scale**2 * self.tree.free[:, None, None]

    def said(self, batch: np.ndarray) -> tuple[Latent]:
        """-> the components that are a batch's own, now; the codes of what changed its component are those of the new one."""
        vectors = from_middle(self.local[batch], self.middle)
        near = self.mixture.near(vectors)
        changed = near.chosen != self.chosen[batch]
        self.shared[batch[changed]] = near.encode(vectors)[changed]
        self.chosen[batch], self.row[batch] = near.chosen, np.arange(len(batch))
        at = self.shared[batch]
        decoded, slopes = near.linearise(at)
        return (Latent.asked(self.middle, decoded, slopes, at, self.information, np.zeros(len(at)), self.row),)

    def said_again(self, said: tuple, batch: np.ndarray) -> tuple[Latent]:
        return self.said(batch)

    def round(self, said: tuple, tau: float, scales2: np.ndarray, most: int, batch: np.ndarray) -> None:
        """Go to where the component has it."""
        self.solve(said, tau, scales2, most, batch)
        self.cost[batch] = self.costs(said, scales2[-1], batch) + self.beside[self.chosen[batch]]
        now = self.mixture.near(from_middle(self.local[batch], self.middle)).chosen
        self.status[batch[now != self.chosen[batch]]] = RAN_OUT

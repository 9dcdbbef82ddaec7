"""Poses under a mixture: the component in which a pose costs least stands for the whole mixture, until another is cheaper.

Within a component all is linear, so that no round makes anything worse; a frame is done when it has converged in the component
that is its own there. What it costs to be in a component, the wider and the rarer the more, counts.
"""

from dataclasses import replace

import numpy as np

from mocapfix.kernels.levenberg import RAN_OUT
from mocapfix.kernels.terms import Latent
from mocapfix.prior.contract import from_middle
from mocapfix.prior.mixture import Mixture
from mocapfix.solve.poses import EACH, FAR, NEAR, Search, Watch


class Competing(Search):
    """A solve under way. Codes of which nobody says the component mean nothing: each begins as its pose's."""

    def __init__(self, *begun):
        super().__init__(*begun)
        self.mixture = replace(self.model, spreads=self.scale * self.model.spreads, sigma=self.scale * self.model.sigma)
        self.chosen = np.full(len(self.root), -1)

    def rounds(self, scales2: np.ndarray, most: int, watch: Watch | None, batch: np.ndarray) -> None:
        """Go to where its component has each frame of a batch, until that is where it stays the cheapest."""
        tau = FAR
        while len(batch):
            latent = self.own(batch)
            self.solve(latent, tau, scales2, min(EACH, most), batch)
            self.cost[batch] = self.costs(latent, scales2[-1], batch) + self.mixture.offsets[self.chosen[batch]]
            self.status[batch[self.near(batch).chosen != self.chosen[batch]]] = RAN_OUT
            batch = batch[self.unfinished(batch, most)]
            tau, scales2 = NEAR, scales2[-1:]
            if watch:
                watch(self.root, self.local, self.scale * self.shared)

    def near(self, batch: np.ndarray) -> Mixture:
        return self.mixture.near(from_middle(self.local[batch], self.mixture.middle))

    def own(self, batch: np.ndarray) -> Latent:
        """-> the components that are a batch's own, now; the codes of what changed its component are those of the new one."""
        near = self.near(batch)
        changed = near.chosen != self.chosen[batch]
        codes = near.encode(from_middle(self.local[batch], near.middle))
        self.shared[batch[changed]] = codes[changed]
        self.chosen[batch], self.row[batch] = near.chosen, np.arange(len(batch))
        at = self.shared[batch]
        decoded, slopes = near.linearise(at)
        middle, hold = np.ascontiguousarray(near.middle), np.zeros(len(at))
        return Latent(middle, decoded, np.ascontiguousarray(slopes), at, near.information, hold, self.row)

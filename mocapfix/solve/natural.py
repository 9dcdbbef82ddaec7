"""Poses under the paper's number, g (MNN-IK, Eq. 3.1): one more residual, which depends on all joints.

Its value and its gradient are asked for between rounds. Within one the joints are held near where that was, as a code is, and a
round that made the cost higher is taken back.
"""

import numpy as np

from mocapfix.kernels.levenberg import RAN_OUT
from mocapfix.kernels.terms import Courses, Whole
from mocapfix.solve.poses import EACH, ENOUGH, FAR, FIRMER, HOLD, NEAR, Search, Watch


class Natural(Search):
    """A solve under way, without a code."""

    def __init__(self, tree, others, model, scale, root, local, codes):
        frames, at = len(root), np.empty(local.shape)
        self.number = Whole(np.empty(frames), np.empty(at.shape[:3]), at, np.full(frames, (scale * model.deviation) ** -2))
        self.held = Courses(at, np.full(at.shape[:2], HOLD), np.zeros((frames, 3)), np.zeros(frames))
        super().__init__(tree, (*others, self.held), model, scale, root, local, codes)

    def rounds(self, scales2: np.ndarray, most: int, watch: Watch | None, batch: np.ndarray) -> None:
        """Solve a batch of frames, asking for the number again between rounds; the first goes through all robust scales."""
        self.ask(batch)
        self.cost[batch], tau = self.costs(self.number, scales2[-1], batch), FAR
        while len(batch):
            before = self.root[batch], self.local[batch]
            self.solve(self.number, tau, scales2, min(EACH, most), batch)
            self.ask(batch)
            fall = self.cost[batch] - self.costs(self.number, scales2[-1], batch)
            worse = ~(fall >= 0)
            back = batch[worse]
            self.root[back], self.local[back] = before[0][worse], before[1][worse]
            self.ask(back)
            self.held.weight[back] *= FIRMER
            self.cost[batch] -= np.where(worse, 0.0, fall)
            self.status[batch[worse | (fall > ENOUGH)]] = RAN_OUT
            batch = batch[self.unfinished(batch, most)]
            tau, scales2 = NEAR, scales2[-1:]
            if watch:
                watch(self.root, self.local, self.shared)

    def ask(self, frames: np.ndarray) -> None:
        """Take the number, and how it changes, where some frames are; there they are held."""
        if len(frames):
            self.number.at[frames] = self.local[frames]
            self.number.value[frames], self.number.gradient[frames] = self.model.at(self.local[frames])

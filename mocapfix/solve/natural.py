"""Poses under the paper's number, g (MNN-IK, Eq. 3.1): one more residual, which depends on all joints.

Its value and its gradient are asked for between rounds; within one the joints are held near where that was, as a code is.
"""

import numpy as np

from mocapfix.kernels.terms import Courses, Whole
from mocapfix.solve.search import Search


class Natural(Search):
    """A solve under way, without a code."""

    def __init__(self, tree, others, model, scale, root, local, codes):
        super().__init__(tree, others, model.autoencoder, scale, root, local, codes)
        self.naturalness, frames = model, len(root)
        none, at = np.zeros((frames, 3)), np.empty_like(self.local)
        self.number = Whole(np.empty(frames), np.empty(at.shape[:3]), at, np.full(frames, (scale * model.deviation) ** -2))
        self.held = Courses(at, np.empty(at.shape[:2]), none, np.zeros(frames))

    def said(self, batch: np.ndarray) -> tuple[Whole, Courses]:
        """-> the number, linearised where a batch of frames is, and what holds these there."""
        self.number.at[batch], self.held.weight[batch] = self.local[batch], self.hold[batch, None]
        self.number.value[batch], self.number.gradient[batch] = self.naturalness.at(self.local[batch])
        return self.number, self.held

    def said_again(self, said: tuple, batch: np.ndarray) -> tuple[Whole, Courses]:
        return self.said(batch)

    def said_now(self, said: tuple, batch: np.ndarray) -> tuple[Whole, Courses]:
        return self.said(batch)

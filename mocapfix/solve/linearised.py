"""A model of poses as the sweep wants it, linear near some codes, and how steps mend what it says of its derivative."""

import numpy as np

from mocapfix.kernels.terms import Latent
from mocapfix.prior.contract import PoseModel


def linearised(model: PoseModel, scale: float, shared: np.ndarray, hold: float, row: np.ndarray) -> Latent:
    """-> a model as a term, its deviations times `scale`, linearised at codes of scale times `shared` (D, P)."""
    told = shared[:1] if (shared == shared[0]).all() else shared  # alike as they are at first, where nobody knows better
    decoded, slopes = (np.repeat(each, len(shared) // len(told), axis=0) for each in model.linearise(scale * told))
    middle, information = np.ascontiguousarray(model.middle), model.information / scale**2
    return Latent(middle, decoded, scale * slopes, shared.copy(), information, np.full(len(shared), hold), row)


def mend(latent: Latent, rows: np.ndarray, said: np.ndarray, step: np.ndarray) -> None:
    """Make the derivative agree with what the model says after a step (B, P) from where it `said` (B, J, 3).

    The least change that does so, Broyden's (1965).
    """
    count, size = step.shape
    slopes = latent.jacobian[rows].reshape(count, -1, size)
    missed = (latent.decoded[rows] - said).reshape(count, -1, 1) - slopes @ step[..., None]
    slopes += missed * (step / np.maximum((step**2).sum(1, keepdims=True), 1e-12))[:, None]
    latent.jacobian[rows] = slopes.reshape(count, -1, 3, size)

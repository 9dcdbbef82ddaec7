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


def mend(latent: Latent, rows: np.ndarray, at: np.ndarray, decoded: np.ndarray) -> None:
    """Move some rows' linearisation to codes `at` (B, P) that are known to mean `decoded` (B, J, 3).

    The derivative changes by the least that makes it agree with the step there, as Broyden's (1965).
    """
    count, size = at.shape
    step, slopes = at - latent.at[rows], latent.jacobian[rows].reshape(count, -1, size)
    missed = (decoded - latent.decoded[rows]).reshape(count, -1, 1) - slopes @ step[..., None]
    slopes += missed * (step / np.maximum((step**2).sum(1, keepdims=True), 1e-12))[:, None]
    latent.at[rows], latent.decoded[rows], latent.jacobian[rows] = at, decoded, slopes.reshape(count, -1, 3, size)

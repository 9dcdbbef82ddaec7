"""A model of poses as the sweep wants it, linear near some codes."""

import numpy as np

from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Latent
from mocapfix.prior.contract import PoseModel


def linearised(tree: Tree, model: PoseModel, scale: float, shared: np.ndarray, hold: float, row: np.ndarray) -> Latent:
    """-> a model as a term, its deviations times `scale`, linearised at codes of scale times `shared` (D, P)."""
    alike = (shared == shared[0]).all()  # as they are at first, where nobody knows better
    told, times = shared[:1] if alike else shared, len(shared) if alike else 1
    decoded, slopes = model.linearise(scale * told)
    information = model.information / scale**2 * tree.free[:, None, None]
    term = Latent.asked(model.middle, decoded, scale * slopes, told, information, np.full(len(shared), hold), row)
    each = {name: np.repeat(getattr(term, name), times, axis=0) for name in ("decoded", "jacobian", "at", "curvature")}
    return term._replace(**each)

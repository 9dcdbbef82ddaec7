"""Poses under a learned model: the model's code is an unknown of the solve, its decoder linear near where it was asked.

A linear model is asked once. A network is asked anew between rounds: see `search`. Mixtures and the paper's number go otherwise:
see `competing` and `natural`.
"""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.kernels.pose import Tree
from mocapfix.kernels.threads import side_by_side
from mocapfix.prior.contract import PoseModel
from mocapfix.prior.mixture import Mixture
from mocapfix.solve.competing import Competing
from mocapfix.solve.linearised import linearised
from mocapfix.solve.natural import Natural
from mocapfix.solve.search import FAR, Search, Watch

if TYPE_CHECKING:  # for it brings torch with it
    from mocapfix.prior.naturalness import Naturalness

PLAIN = np.array([np.inf])  # no robust scale
BATCH = 128  # frames at once: what a network says of them takes some 25 kB each


@dataclass(frozen=True)
class Posed:
    """Solved poses.

    root        (T, 3) metres
    rotations   (T, J, 3, 3) local
    codes       (T, P) of the model, each number in its own standard deviations
    status      (T,) indices into motion.STATUS
    iterations  (T,) of the Levenberg-Marquardt solve, over all rounds
    cost        (T,) half the sum of squares of all residuals, in standard deviations; of a mixture also what its component costs
                beside, over the cheapest: the logarithm of its spread over its weight
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
    batches = np.array_split(frames, 1 if watch else -(-len(frames) // BATCH)) if len(frames) else []
    if isinstance(model, PoseModel) and model.linear:
        once = (linearised(tree, model, scale, codes[:1] / scale, 0.0, search.row),)
        side_by_side(partial(search.solve, once, FAR, scales2, most), batches)
        search.cost = search.costs(once, scales2[-1], frames)
        if watch:
            watch(search.root, search.local, scale * search.shared)
    else:
        side_by_side(partial(search.rounds, scales2, most, watch), batches)
    return Posed(search.root, search.local, scale * search.shared, search.status, search.iterations, search.cost)


def searching(model: "PoseModel | Naturalness") -> type[Search]:
    """-> how such a model is searched."""
    return Competing if isinstance(model, Mixture) else Search if isinstance(model, PoseModel) else Natural

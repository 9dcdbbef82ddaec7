"""What poses cost, without moving them."""

from numba import njit

from mocapfix.kernels.pose import forward
from mocapfix.kernels.system import linearise
from mocapfix.kernels.workspace import load, workspace


@njit(cache=True, nogil=True)
def cost_frames(tree, terms, frames, scale2, rows, root, local, shared, cost):
    """Write into cost (F,) what the terms say of some `frames` (F,): half the sum of squares, robust where a term is."""
    work = workspace(local.shape[1], shared.shape[1], rows)
    for i in range(len(frames)):
        t = frames[i]
        load(root, local, shared, t, work.pose)
        forward(tree, work.pose)
        cost[i] = linearise(tree, terms, t, scale2, work.pose, work.system)

"""The baseline of Learnable SMPLify: SMPLify's optimisation with Adam, joints and a pose prior, a fixed number of iterations.

As in the paper's baseline, the pose starts at the given start and the root at the given position. There is no image and no mesh:
the cost is the squared distance of the joints, and a weak pull of the rotations towards the start.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.skeleton import Skeleton
from mocapfix.solve.kinematics import Poses
from mocapfix.train.graph_ik import compute_world_tensors
from mocapfix.train.ik_losses import TreeLevels, compute_rotation_exponential

SMPLIFY_ITERATIONS = 100
SMPLIFY_LEARNING_RATE = 0.03
"""A compromise: on held-out people 0.01, 0.03 and 0.1 leave 0.5, 0.6 and 2.0 mm one frame from the start, and 10.0, 4.5 and
3.3 mm nine frames from it."""
SMPLIFY_PRIOR_WEIGHT = 1e-5  # m^2/rad^2: weight of the rotations' change beside the joints' squared distances


def optimise_poses(
    skeleton: Skeleton, start: Poses, positions: Float[np.ndarray, "T J 3"], learning_rate: float = SMPLIFY_LEARNING_RATE
) -> Poses:
    """Return the poses after SMPLIFY_ITERATIONS of Adam from a start, given all joint positions in metres.

    Each frame is optimised on its own: Adam's steps are element by element.
    """
    levels, offsets = TreeLevels.build(skeleton.parents), torch.as_tensor(skeleton.offsets, dtype=torch.float32)
    target, local = (torch.as_tensor(each, dtype=torch.float32) for each in (positions, start[1]))
    change = torch.zeros((*local.shape[:2], 3), requires_grad=True)
    root = torch.as_tensor(positions[:, 0], dtype=torch.float32).requires_grad_(True)
    world = torch.eye(3).expand(len(local), 3, 3)
    optimizer = torch.optim.Adam([change, root], learning_rate)
    for _ in range(SMPLIFY_ITERATIONS):
        placed = compute_world_tensors(levels, offsets, root, _turn(local, change), world)
        cost = ((placed.position - target) ** 2).sum() + SMPLIFY_PRIOR_WEIGHT * (change**2).sum()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
    with torch.no_grad():
        return root.numpy().astype(float), _turn(local, change).numpy().astype(float)


def _turn(local: Tensor, change: Tensor) -> Tensor:
    return local @ compute_rotation_exponential(change)

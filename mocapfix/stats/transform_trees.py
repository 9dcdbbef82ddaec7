"""Transforms along a tree of joints."""

import numpy as np
from jaxtyping import Float, Int


def compose_transforms(
    parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "T J 3"], rotations: Float[np.ndarray, "T J 3 3"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Compose local positions and rotations along a tree of joints, parents before children, into those in the world."""
    position_world, rotation_world = positions.copy(), rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            offset_world = (rotation_world[:, parent] @ positions[:, joint, :, None])[..., 0]
            position_world[:, joint] = position_world[:, parent] + offset_world
            rotation_world[:, joint] = rotation_world[:, parent] @ rotations[:, joint]
    return position_world, rotation_world

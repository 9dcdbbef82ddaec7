"""Keep the distance from ankle to toes where each shall be at a place of its own: a foot is rigid between them."""

import numpy as np
from jaxtyping import Float

HORIZONTAL_AXES = [0, 2]
UP_AXIS = 1
MIN_HELD_SHARE = 1e-3
"""Share that a joint which is not held counts beside one that is."""
MIN_DISTANCE_M = 1e-3
"""Horizontal distance from ankle to toes below which the direction from one to the other is not known."""


def restore_foot_length(
    ankle: Float[np.ndarray, "T 3"],
    toe: Float[np.ndarray, "T 3"],
    held_share: tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]],
    length_m: Float[np.ndarray, " T"],
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Return ankle and toes, in metres with Y up, moved towards or from each other until they are one foot's length apart.

    They move in the horizontal plane only, so that none of them sinks into the floor.

    held_share  of the ankle and of the toes: 1 where they are held, 0 where not; the one that is held moves less
    """
    ankle_share, toe_share = (np.maximum(share, MIN_HELD_SHARE)[:, None] for share in held_share)
    between = toe - ankle
    distance = np.maximum(np.linalg.norm(between[:, HORIZONTAL_AXES], axis=1), MIN_DISTANCE_M)
    wanted = np.sqrt(np.maximum(length_m**2 - between[:, UP_AXIS] ** 2, MIN_DISTANCE_M**2))
    correction = (1 - wanted / distance)[:, None] * between
    correction[:, UP_AXIS] = 0.0
    ankle_part = toe_share / (ankle_share + toe_share)
    return ankle + ankle_part * correction, toe - (1 - ankle_part) * correction

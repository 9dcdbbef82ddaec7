"""Keep the distance from ankle to toes where each shall be at a place of its own: a foot is rigid between them."""

import numpy as np
from jaxtyping import Float

HORIZONTAL_AXES = [0, 2]
UP_AXIS = 1
MIN_HELD_SHARE = 1e-3
"""Share that a joint which is not held counts beside one that is."""
MIN_DISTANCE_M = 1e-3
"""Distance from ankle to toes below which the direction from one to the other is not known."""
STEEP_FOOT_SINES = (0.5, 0.85)
"""Sine of a foot's slope up to which ankle and toes move horizontally alone, and from which they move along the foot: on the toes
a small change of its length would take a large horizontal movement of the ankle."""


def restore_foot_length(
    ankle: Float[np.ndarray, "T 3"],
    toe: Float[np.ndarray, "T 3"],
    held_share: tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]],
    length_m: Float[np.ndarray, " T"],
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Return ankle and toes, in metres with Y up, moved towards or from each other until they are one foot's length apart.

    They move in the horizontal plane only, so that none of them sinks into the floor; those of a steep foot along the foot.

    held_share  of the ankle and of the toes: 1 where they are held, 0 where not; the one that is held moves less
    """
    ankle_share, toe_share = (np.maximum(share, MIN_HELD_SHARE)[:, None] for share in held_share)
    between = toe - ankle
    distance = np.maximum(np.linalg.norm(between, axis=1), MIN_DISTANCE_M)
    flat_distance = np.maximum(np.linalg.norm(between[:, HORIZONTAL_AXES], axis=1), MIN_DISTANCE_M)
    flat_length = np.sqrt(np.maximum(length_m**2 - between[:, UP_AXIS] ** 2, MIN_DISTANCE_M**2))
    steepness = np.clip((np.abs(between[:, UP_AXIS]) / distance - STEEP_FOOT_SINES[0]) / np.ptp(STEEP_FOOT_SINES), 0, 1)
    along_share = steepness**2 * (3 - 2 * steepness)
    flat_correction = (1 - flat_length / flat_distance)[:, None] * between
    flat_correction[:, UP_AXIS] = 0.0
    along_correction = (1 - length_m / distance)[:, None] * between
    correction = flat_correction + along_share[:, None] * (along_correction - flat_correction)
    ankle_part = toe_share / (ankle_share + toe_share)
    return ankle + ankle_part * correction, toe - (1 - ankle_part) * correction

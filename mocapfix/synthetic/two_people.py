"""Two people in one take: one is moved beside the other, or so that their paths cross."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mocapfix.errors import SceneError

SHIFT_STEP_M = 0.05  # in which the distance of the second person is found
MAX_SHIFT_M = 20.0
HALF_TURN = np.diag([-1.0, 1.0, -1.0])  # about the vertical axis
PERSON_NAMES = ("P1", "P2")


@dataclass(frozen=True)
class TwoPersonTake:
    """The markers of two people: those of the first, then those of the second.

    markers      (T, M, 3) metres, Y up
    labels       M labels with the names of the people before them
    first_count  number of markers of the first person
    """

    markers: Float[np.ndarray, "T M 3"]
    labels: tuple[str, ...]
    first_count: int


def place_two_people(
    first: Float[np.ndarray, "T1 M1 3"],
    second: Float[np.ndarray, "T2 M2 3"],
    labels: tuple[tuple[str, ...], tuple[str, ...]],
    distance_m: float = 1.0,
    *,
    crossing: bool = False,
) -> TwoPersonTake:
    """Return the markers of two people, of the frames that both have, with a smallest distance between their centres.

    Args:
        first: markers (metres, Y up, NaN where missing) of the first person, who stays in place.
        second: those of the second person.
        labels: their labels.
        distance_m: smallest horizontal distance between the centres of their markers.
        crossing: turn the second person round, so that both pass each other in the middle of the take; otherwise the second
            person is beside the first.
    """
    frame_count = min(len(first), len(second))
    first, second = first[:frame_count], second[:frame_count] @ (HALF_TURN if crossing else np.eye(3))
    one, other = _compute_centres(first), _compute_centres(second)
    frames = slice(frame_count // 2, frame_count // 2 + 1) if crossing else slice(None)
    alignment = np.nanmean(one[frames], axis=0) - np.nanmean(other[frames], axis=0)
    path = one - np.nanmean(one, axis=0)
    _, _, axes = np.linalg.svd(path[~np.isnan(path[:, 0])], full_matrices=False)
    for shift_m in np.arange(0.0, MAX_SHIFT_M, SHIFT_STEP_M):
        shift = alignment + shift_m * axes[1]  # across the direction in which the first person mostly moves
        if np.nanmin(np.linalg.norm(other + shift - one, axis=1)) >= distance_m:
            markers = np.concatenate([first, second + np.array([shift[0], 0.0, shift[1]])], 1)
            names = [f"{name}:{label}" for name, own in zip(PERSON_NAMES, labels, strict=True) for label in own]
            return TwoPersonTake(markers, tuple(names), first.shape[1])
    raise SceneError(f"The two people cannot be placed {distance_m:g} m apart.")


def _compute_centres(markers: np.ndarray) -> np.ndarray:
    """Return the horizontal centre (T, 2) of the markers of each frame."""
    return np.nanmedian(markers[..., [0, 2]], axis=1)

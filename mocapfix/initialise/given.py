"""What somebody gives to be posed, made sure of."""

import numpy as np
from numpy.typing import ArrayLike

from mocapfix.errors import ConstraintError
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.subject import Subject

LEAST = 1e-6  # metres: nobody knows a joint better


def known_skeleton(subject: Subject) -> Skeleton:
    """-> the subject's skeleton. Raises ConstraintError where it is not the CMU skeleton's 31 joints."""
    if subject.skeleton.names != cmu31().skeleton.names:
        raise ConstraintError("HybrIK is for the 31 joints of the CMU skeleton; the subject's are others.")
    return subject.skeleton


def array(name: str, given: ArrayLike, shape: tuple[int | None, ...], unknown: bool = True) -> np.ndarray:
    """-> what was given, as the kernels want it. Raises ConstraintError where it has not the shape, None being any number; or
    where a number is infinite or, unless some may be unknown, NaN."""
    try:
        found = np.asarray(given).astype(float, order="C", casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise ConstraintError(f"{name} must be an array of numbers ({error}).") from error
    wanted = ", ".join("any" if length is None else str(length) for length in shape)
    if found.ndim != len(shape) or any(b not in {None, a} for a, b in zip(found.shape, shape, strict=True)):
        raise ConstraintError(f"{name} must be of shape ({wanted}), not {found.shape}.")
    if np.isinf(found).any() or (not unknown and np.isnan(found).any()):
        raise ConstraintError(f"{name} holds a number that is not finite{'; what is unknown must be NaN' if unknown else ''}.")
    return found


def variances(deviation: ArrayLike, positions: np.ndarray, count: int) -> np.ndarray:
    """-> (T or 1, Q) m^2 per axis: of joints, as their deviation says, and 0 of the other points, which have their own spread.

    Raises ConstraintError where the deviation of a known joint is not from LEAST up.
    """
    shape = positions.shape[:2] if np.ndim(deviation) else ()
    deviation = array("deviation", deviation, shape)
    known = ~np.isnan(positions).any(axis=2) if shape else ()
    if not (deviation[known] >= LEAST).all():
        raise ConstraintError(f"A deviation must be {LEAST:g} metres or more wherever the joint's position is known.")
    found = np.zeros((len(positions) if shape else 1, count))
    found[:, : positions.shape[1]] = np.nan_to_num(np.square(deviation), nan=1.0)  # of what is unknown nobody asks
    return found

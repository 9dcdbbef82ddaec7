"""BVH and AMC of any body whose joints mocapfix knows by name."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from mocapfix import hierarchies, retarget
from mocapfix.animation import Animation
from mocapfix.errors import ReadError
from mocapfix.fitted import fitted
from mocapfix.read import amc as amc_file
from mocapfix.read import bvh as bvh_file
from mocapfix.train.recordings.recording import Recording, step, subject


def bvh(path: Path) -> Iterator[Recording]:
    """Yield the motion of a BVH. Raises ReadError where it is none or not of a whole body."""
    yield _recording(path, bvh_file.animation)


def amc(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMC. Raises ReadError where it is none, its ASF is not beside it, or it is not of a whole body."""
    yield _recording(path, amc_file.animation)


def _recording(path: Path, read: Callable[[Path], Animation]) -> Recording:
    animation = read(path)
    choice = hierarchies.mapped(animation.names, animation.parents)
    if choice.mapped is None:
        raise ReadError(f"{path}: {choice.reason}")
    fit = fitted(animation, choice.mapped)
    if fit is None:
        raise ReadError(f"{path}: its figure never stands, so how its joints turn cannot be told.")
    every = step(animation.rate)
    kept = animation.with_values(animation.values[int(animation.begins_posed) :: every])
    _, rotations = retarget.to_cmu31(kept, fit)
    whole = ~np.isnan(rotations).any((1, 2, 3))
    return Recording(path.stem, subject(path), rotations[whole], animation.rate / every)

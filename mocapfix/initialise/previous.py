"""The classical start: each frame goes on from the solved pose of the one before it.

It is near, and so a few iterations are saved; but frames can no longer be solved side by side, and a frame that ends wrong leads
the next one astray.
"""

from dataclasses import replace

import numpy as np

from mocapfix.motion import Motion

WELL = 0.5  # of the markers that are ever seen: with so many, a frame's own start is one to go on from


def going_on(start: Motion, seen: np.ndarray) -> Motion:
    """-> a start without poses, NaN, after the first frame that is seen well: from there each goes on from the one before.

    start  a pose of its own for every frame
    seen   (T, K) bool: the markers that are believed
    """
    well = seen.sum(axis=1) >= WELL * seen.any(axis=0).sum()
    later = np.arange(start.frames) > well.argmax()
    root, rotations = start.root.copy(), start.rotations.copy()
    root[later] = rotations[later] = np.nan
    return replace(start, root=root, rotations=rotations)

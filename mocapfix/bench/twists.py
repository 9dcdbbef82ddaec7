"""How far people's bones are twisted, joint by joint: the figure of HybrIK's section 3.3 (its Fig. 5), for CMU's motion."""

from pathlib import Path

import numpy as np

from mocapfix.initialise.twist import bones, twists
from mocapfix.skeleton import average
from mocapfix.train import recordings
from mocapfix.train.flips import longest_between

PERCENTILES = (1, 25, 50, 75, 99)


def distribution(data: Path) -> dict[str, tuple[float, ...]]:
    """-> degrees: PERCENTILES of the twist of each joint that has a bone, over all motion in a folder; flips are left out.

    Raises ReadError where there is none.
    """
    body = average()
    along, found = bones(body), []
    has = ~np.isnan(along[:, 0])
    for recording in recordings.read(data):
        kept = longest_between(recording.rotations[:, has], recording.rate)
        told = twists(recording.rotations[kept][:, has], along[has])
        found.append(np.degrees(np.arctan2(told[..., 1], told[..., 0])))
    spread = np.nanpercentile(np.concatenate(found), PERCENTILES, axis=0).T
    names = [name for name, it in zip(body.names, has, strict=True) if it]
    return {name: tuple(map(float, row)) for name, row in zip(names, spread, strict=True)}

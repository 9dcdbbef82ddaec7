"""Shards of CMU motion: `euler` int16 (frames, 31, 3) of all trials, ZYX, 32767 = 180 degrees; skeletons.json beside them.

A shard of motion that was put back together from another skeleton (its name says approx) is left out: it is 2 cm off.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import cmu31
from mocapfix.train.recordings.recording import RATE, Recording


def read(path: Path) -> Iterator[Recording]:
    """Yield the trials of a shard; nothing of a file that is none."""
    try:
        with np.load(path) as shard:
            if "euler" not in shard or "approx" in path.name:
                return
            euler, trials, starts = shard["euler"], shard["trial"], shard["start"]
        joints = tuple(json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))["joints"])
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is no shard of motion with its skeletons.json beside it ({error}).") from error
    if joints != cmu31().skeleton.names or euler.shape[1:] != (len(joints), 3):
        raise ReadError(f"{path}: its joints are not the 31 of the CMU skeleton, in their order.")
    for name, angles in zip(trials, np.split(euler, starts[1:]), strict=True):
        turned = Rotation.from_euler("ZYX", angles.reshape(-1, 3) / 32767 * 180, degrees=True).as_matrix()
        yield Recording(str(name), str(name).split("_")[0], turned.reshape(*angles.shape, 3), RATE)

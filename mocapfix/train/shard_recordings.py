"""Recordings: motion as joint rotations; and the reader of shards of CMU motion.

A shard holds `euler` int16 (frames, 31, 3) of all its trials, in the order ZYX, where 32767 is 180 degrees; skeletons.json is in
the same folder. Shards of motion that was reconstructed from another skeleton (their name contains approx) are not read: they are
2 cm off.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import load_cmu31_body

TRAINING_RATE_HZ = 30.0  # poses at a higher rate hold hardly more information


@dataclass(frozen=True)
class Recording:
    """A trial of a subject.

    rotations  (T, 31, 3, 3) local joint rotations, Y up; in the T-pose that faces +Z the axes of each joint are those of the
               world
    """

    name: str
    subject: str
    rotations: np.ndarray
    rate_hz: float


def compute_frame_step(rate_hz: float) -> int:
    """Return the number of frames per frame kept, for a rate close to TRAINING_RATE_HZ."""
    return max(1, round(rate_hz / TRAINING_RATE_HZ))


def infer_subject(path: Path) -> str:
    """Return the subject of a file by CMU's naming, 01 of 01_02.bvh; otherwise the name of its folder."""
    subject, underscore, _ = path.stem.partition("_")
    return subject if underscore else path.parent.name


def read_shard_recordings(path: Path) -> Iterator[Recording]:
    """Yield the trials of a shard, and nothing if the file is not a shard. Raises ReadError if a shard is invalid."""
    try:
        with np.load(path) as shard:
            if "euler" not in shard or "approx" in path.name:
                return
            euler, trials, starts = shard["euler"], shard["trial"], shard["start"]
        joints = tuple(json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))["joints"])
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is not a shard of motion with its skeletons.json in the same folder ({error}).") from error
    if joints != load_cmu31_body().skeleton.names or euler.shape[1:] != (len(joints), 3):
        raise ReadError(f"{path}: its joints are not the 31 of the CMU skeleton, in their order.")
    for name, angles in zip(trials, np.split(euler, starts[1:]), strict=True):
        rotations = Rotation.from_euler("ZYX", angles.reshape(-1, 3) / 32767 * 180, degrees=True).as_matrix()
        yield Recording(str(name), str(name).split("_")[0], rotations.reshape(*angles.shape, 3), TRAINING_RATE_HZ)

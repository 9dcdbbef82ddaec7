"""A recording: what somebody did, as joint rotations."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import load_cmu31_body

# MERGED: mocapfix.train.recordings.recording
TRAINING_RATE_HZ = 30.0  # Hz: poses that follow sooner say nothing new


@dataclass(frozen=True)
class Recording:
    """A trial of a subject.

    rotations  (T, 31, 3, 3) local joint rotations, Y up, each joint's axes along the world's in the T-pose that faces +Z
    rate       Hz
    """

    name: str
    subject: str
    rotations: np.ndarray
    rate_hz: float


def compute_frame_step(rate_hz: float) -> int:
    """-> of how many frames one is kept, to come near RATE."""
    return max(1, round(rate_hz / TRAINING_RATE_HZ))


def infer_subject(path: Path) -> str:
    """-> whose trial a file is, as CMU names them: 01 of 01_02.bvh; else its folder says it."""
    person, underscore, _ = path.stem.partition("_")
    return person if underscore else path.parent.name


# MERGED: mocapfix.train.recordings.shards
# Shards of CMU motion: `euler` int16 (frames, 31, 3) of all trials, ZYX, 32767 = 180 degrees; skeletons.json beside them.
#
# A shard of motion that was put back together from another skeleton (its name says approx) is left out: it is 2 cm off.
def read_shard_recordings(path: Path) -> Iterator[Recording]:
    """Yield the trials of a shard; nothing of a file that is none."""
    try:
        with np.load(path) as shard:
            if "euler" not in shard or "approx" in path.name:
                return
            euler, trials, starts = shard["euler"], shard["trial"], shard["start"]
        joints = tuple(json.loads((path.parent / "skeletons.json").read_text(encoding="utf-8"))["joints"])
    except (OSError, ValueError, KeyError) as error:
        raise ReadError(f"{path}: is no shard of motion with its skeletons.json beside it ({error}).") from error
    if joints != load_cmu31_body().skeleton.names or euler.shape[1:] != (len(joints), 3):
        raise ReadError(f"{path}: its joints are not the 31 of the CMU skeleton, in their order.")
    for name, angles in zip(trials, np.split(euler, starts[1:]), strict=True):
        turned = Rotation.from_euler("ZYX", angles.reshape(-1, 3) / 32767 * 180, degrees=True).as_matrix()
        yield Recording(str(name), str(name).split("_")[0], turned.reshape(*angles.shape, 3), TRAINING_RATE_HZ)

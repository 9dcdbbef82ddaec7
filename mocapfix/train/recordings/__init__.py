"""Motion to learn from: shards of the CMU database, BVH, ASF/AMC, and AMASS npz, all as rotations of the 31 joints."""

from collections.abc import Callable, Iterator
from pathlib import Path

from mocapfix.errors import ReadError
from mocapfix.train.recordings import amass, animations, shards
from mocapfix.train.recordings.recording import Recording

READERS: tuple[tuple[str, Callable[[Path], Iterator[Recording]]], ...] = (
    ("*.npz", shards.read),
    ("*.npz", amass.read),
    ("*.bvh", animations.bvh),
    ("*.amc", animations.amc),
)


def read(folder: Path) -> Iterator[Recording]:
    """Yield all the motion in a folder and the folders in it, always in the same order.

    Raises ReadError where there is none, or naming the file that is not what it should be.
    """
    found = False
    for pattern, reader in READERS:
        for path in sorted(Path(folder).rglob(pattern)):
            for recording in reader(path):
                found = True
                yield recording
    if not found:
        raise ReadError(f"{folder}: holds no motion; give a folder of BVH, ASF/AMC, AMASS npz, or shards of CMU motion.")

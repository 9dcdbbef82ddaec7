"""Poses to learn from: people's motion without place, heading and flips, as it is and mirrored."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.prior.contract import from_middle
from mocapfix.skeleton import cmu31
from mocapfix.train import recordings
from mocapfix.train.flips import longest_between
from mocapfix.train.mirror import mirrored

# Joints of which the data say little, and whose flips therefore do not matter.
SLIGHT = ("HipJoint", "FingerBase", "HandIndex1", "Thumb", "ToeBase")


@dataclass(frozen=True)
class Poses:
    """Rotation vectors from a middle pose, the root's its tilt, in radians, in single precision.

    seen, unseen  (N, J, 3) and (M, J, 3) of the subjects to be learned from and of those kept from it; each pose is there
                  twice, the second half being the first mirrored
    frames        subject: how many frames were taken of him, before mirroring
    dropped       frames beyond a flip, which were not
    """

    seen: np.ndarray
    unseen: np.ndarray
    frames: Counter[str]
    dropped: int


def slight(names: tuple[str, ...]) -> np.ndarray:
    """-> (J,) bool: which joints are slight."""
    return np.array([name.endswith(SLIGHT) for name in names])


def gather(
    folder: Path, middle: np.ndarray, test: frozenset[str], unseen: frozenset[str], progress: Callable[[str], None]
) -> Poses:
    """-> all poses in a folder, but for the subjects of `test`.

    Raises ReadError where the folder holds no motion of those to be learned from, or none of those who are `unseen`.
    """
    names = cmu31().skeleton.names
    firm, frames, dropped = ~slight(names), Counter[str](), 0
    found: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for recording in recordings.read(folder):
        if recording.subject in test:
            continue
        progress(f"reading {recording.name}")
        kept = longest_between(recording.rotations[:, firm], recording.rate)
        vectors = from_middle(recording.rotations[kept], middle).astype(np.float32)  # for there may be millions
        found[recording.subject in unseen].append(vectors)
        frames[recording.subject] += len(vectors)
        dropped += len(recording.rotations) - len(vectors)
    for is_unseen, whom in ((False, "subjects to learn from"), (True, f"the unseen subjects {', '.join(sorted(unseen))}")):
        if not found[is_unseen]:
            raise ReadError(f"{folder}: holds no motion of {whom}.")
    both = (np.concatenate(found[is_unseen]) for is_unseen in (False, True))
    seen, kept_back = (np.concatenate([each, mirrored(each, names)]) for each in both)
    return Poses(seen, kept_back, frames, dropped)

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
    whose         (N,) whose pose each of those seen is: a number for each subject
    frames        subject: how many frames were taken of him, before mirroring; of interleaved ones, to be learned from
    dropped       frames beyond a flip, which were not
    interleaved   whether what is learned from and what is kept are frames of the same takes instead
    """

    seen: np.ndarray
    unseen: np.ndarray
    whose: np.ndarray
    frames: Counter[str]
    dropped: int
    interleaved: bool = False


def slight(names: tuple[str, ...]) -> np.ndarray:
    """-> (J,) bool: which joints are slight."""
    return np.array([name.endswith(SLIGHT) for name in names])


def learned_between(frames: int) -> np.ndarray:
    """-> (T,) bool: which frames MNN-IK's own split learns from, three of every five; the others are for its tests (4.1)."""
    return np.arange(frames) % 5 % 2 == 0


def gather(
    folder: Path,
    middle: np.ndarray,
    test: frozenset[str],
    unseen: frozenset[str],
    progress: Callable[[str], None],
    interleaved: bool = False,
) -> Poses:
    """-> all poses in a folder, but for the subjects of `test`; or those of everybody, by MNN-IK's own split.

    Raises ReadError where the folder holds no motion of those to be learned from, or none of those who are `unseen`.
    """
    names = cmu31().skeleton.names
    firm, frames, dropped = ~slight(names), Counter[str](), 0
    found: dict[bool, list[np.ndarray]] = {True: [], False: []}
    whose: list[str] = []
    for recording in recordings.read(folder):
        if recording.subject in test and not interleaved:
            continue
        progress(f"reading {recording.name}")
        kept = longest_between(recording.rotations[:, firm], recording.rate)
        vectors = from_middle(recording.rotations[kept], middle).astype(np.float32)  # for there may be millions
        by_subject = np.full(len(vectors), recording.subject not in unseen)
        learned = learned_between(len(recording.rotations))[kept] if interleaved else by_subject
        found[False].append(vectors[learned])
        found[True].append(vectors[~learned])
        whose += [recording.subject] * int(learned.sum())
        frames[recording.subject] += int(learned.sum()) if interleaved else len(vectors)
        dropped += len(recording.rotations) - len(vectors)
    for is_unseen, whom in ((False, "subjects to learn from"), (True, f"the unseen subjects {', '.join(sorted(unseen))}")):
        if not any(map(len, found[is_unseen])):
            raise ReadError(f"{folder}: holds no motion of {whom}.")
    both = (np.concatenate(found[is_unseen]) for is_unseen in (False, True))
    seen, kept_back = (np.concatenate([each, mirrored(each, names)]) for each in both)
    return Poses(seen, kept_back, np.tile(np.unique(whose, return_inverse=True)[1], 2), frames, dropped, interleaved)

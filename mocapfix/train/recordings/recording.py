"""A recording: what somebody did, as joint rotations."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

RATE = 30.0  # Hz: poses that follow sooner say nothing new


@dataclass(frozen=True)
class Recording:
    """A trial of a subject.

    rotations  (T, 31, 3, 3) local joint rotations, Y up, each joint's axes along the world's in the T-pose that faces +Z
    rate       Hz
    """

    name: str
    subject: str
    rotations: np.ndarray
    rate: float


def step(rate: float) -> int:
    """-> of how many frames one is kept, to come near RATE."""
    return max(1, round(rate / RATE))


def subject(path: Path) -> str:
    """-> whose trial a file is, as CMU names them: 01 of 01_02.bvh; else its folder says it."""
    person, underscore, _ = path.stem.partition("_")
    return person if underscore else path.parent.name

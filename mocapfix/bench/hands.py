"""MNN-IK's application to optical capture (5.1), on real takes: a hand left with one marker, and hands that cross amid noise.

A sound capture is damaged for a while and cleaned, the person's calibration being known from the sound one; what comes out is
held against that, cleaned too. Beside it stands what numerical inverse kinematics makes of the damaged markers alone.
"""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mocapfix import pipeline, prior, read, write
from mocapfix.bench.contenders import put, unaided
from mocapfix.errors import TakeError
from mocapfix.kernels import kinematics
from mocapfix.kernels.terms import Points
from mocapfix.motion import Motion
from mocapfix.result import Result
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take

SECONDS = 2.0  # that the damage lasts
NOISE = 0.03  # metres per axis, anew in every frame
SD = 0.01  # metres: how sure a marker is said to be, where there is nothing else to believe


class Damage(NamedTuple):
    """What is done to a sound take around one frame."""

    labels: tuple[str, ...]
    joints: tuple[str, ...]  # by which the harm is measured
    when: Callable[[Take], int]
    done: Callable[[np.ndarray], np.ndarray]  # to the markers (T, K, 3)


class Moment(NamedTuple):
    """The middle of the damage: joints (J, 3) and markers (M, 3) in metres, NaN where there are none."""

    skeleton: Skeleton
    measured: list[int]  # joints
    damaged: np.ndarray  # (M,) bool
    before: np.ndarray  # markers: damaged,
    after: np.ndarray  # mended,
    sound: np.ndarray  # and as they were captured
    alone: np.ndarray  # joints: from this frame's damaged markers and nothing else,
    cleaned: np.ndarray  # from the cleaned take,
    true: np.ndarray  # and from the sound one, cleaned
    alone_mm: float  # mean error of the measured joints over all frames of the damage
    cleaned_mm: float


def highest(take: Take) -> int:
    """-> the frame in which the right hand is highest."""
    return int(np.nanargmax(of(take, "RFIN")[:, 1]))


def nearest(take: Take) -> int:
    """-> the frame in which the hands are nearest to one another."""
    return int(np.nanargmin(np.linalg.norm(of(take, "LFIN") - of(take, "RFIN"), axis=1)))


def of(take: Take, label: str) -> np.ndarray:
    """-> (T, 3) metres, a marker. Raises TakeError where the take has none of that name, or never shows it."""
    marker = take.markers[:, column(take, label)]
    if np.isnan(marker).any(axis=1).all():
        raise TakeError(f"{take.name}: never shows the marker {label}; give a take that does.")
    return marker


def column(take: Take, label: str) -> int:
    """-> which of a take's markers goes by a label. Raises TakeError where none does."""
    if label not in take.bare_labels:
        raise TakeError(f"{take.name}: has no marker {label}; give a take in CMU's 41 markers.")
    return take.bare_labels.index(label)


def lost(markers: np.ndarray) -> np.ndarray:
    return np.full_like(markers, np.nan)


def shaken(markers: np.ndarray) -> np.ndarray:
    return markers + np.random.default_rng(0).normal(0, NOISE, markers.shape)


RIGHT = ("RightForeArm", "RightHand", "RightFingerBase")
LEFT = ("LeftForeArm", "LeftHand", "LeftFingerBase")
ONE_MARKER = Damage(("RFRM", "RWRA", "RWRB"), RIGHT, highest, lost)  # RFIN stays
CROSSED = Damage(tuple(side + of for side in "LR" for of in ("FRM", "WRA", "WRB", "FIN")), LEFT + RIGHT, nearest, shaken)


def moment(path: Path, damage: Damage) -> Moment:
    """-> what comes of a capture that is damaged.

    Raises ReadError where the file cannot be read, TakeError where it lacks the markers or no body could be solved.
    """
    take, sound = read.take(path), pipeline.clean(path)
    middle, half = damage.when(take), round(SECONDS / 2 * take.rate)
    columns = [column(take, label) for label in damage.labels]
    during, markers = slice(max(middle - half, 0), middle + half), take.markers.copy()
    markers[during, columns] = damage.done(markers[during, columns])
    with TemporaryDirectory() as folder:
        spoiled = Path(folder) / path.name
        write.c3d(spoiled, take, take.with_markers(markers))
        mended = pipeline.clean(spoiled, subject=sound.subject)
    subject, motion, cleaned, true = mended.subject, mended.motion, mended.joints, sound.joints
    if subject is None or motion is None or cleaned is None or true is None:
        raise TakeError(f"{take.name}: no body could be solved; give a take in CMU's 41 markers.")
    frames = np.arange(len(markers))[during]
    ways = (alone(mended, subject, motion, frames), cleaned[during], true[during])
    joints, at = [subject.skeleton.index(name) for name in damage.joints], int(np.flatnonzero(frames == middle)[0])
    errors = [1e3 * float(np.linalg.norm(way - ways[-1], axis=2)[:, joints].mean()) for way in ways[:2]]
    hurt = np.isin(np.arange(len(take.labels)), columns)
    shown = (markers[middle], mended.take.markers[middle], sound.take.markers[middle])
    return Moment(subject.skeleton, joints, hurt, *shown, *(way[at] for way in ways), *errors)


def alone(mended: Result, subject: Subject, motion: Motion, frames: np.ndarray) -> np.ndarray:
    """-> (N, J, 3) metres: the joints as the damaged markers of each frame alone place them, from the mean pose."""
    take = mended.before
    columns = np.array([take.bare_labels.index(label) if label in take.bare_labels else -1 for label in subject.labels])
    seen = np.ascontiguousarray(take.worn(columns, take.seen).markers[frames])
    points = Points(subject.joints, subject.places, np.nan_to_num(seen), ~np.isnan(seen[..., 0]) / SD**2)
    start = np.tile(prior.load("mean-pose", subject.skeleton).rotations, (len(frames), 1, 1, 1))
    start[:, 0] = motion.rotations[frames, 0]
    return put(subject.skeleton, unaided(kinematics.tree_of(subject.skeleton), points, motion.root[frames], start)).joints
